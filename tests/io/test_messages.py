"""PointCloud2: any layout gives the same points; sizes that do not fit are refused, cheaply."""

import contextlib
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steelnb.io.bag_files import decode_points

from steelnb.errors import InputError


def points(rows: int = 4, columns: int = 6) -> np.ndarray:
    cloud = np.random.default_rng(0).normal(size=(rows, columns, 3)).astype(np.float32).astype(np.float64)
    cloud[1, 2] = np.nan
    return cloud


def field(name, offset, datatype=7, count=1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def message(cloud, kinds="fff", order="xyz", gaps=(0, 0, 0), end=0, row_end=0, big=False, **changed) -> SimpleNamespace:
    """A message through a structured array: ``kinds`` f or d of each field in ``order``, ``gaps`` bytes before each."""
    fields, offset = [], 0
    for name, kind, gap in zip(order, kinds, gaps, strict=True):
        fields.append(field(name, offset + gap, 7 if kind == "f" else 8))
        offset += gap + (4 if kind == "f" else 8)
    rows, columns = cloud.shape[:2]
    formats = [(">" if big else "<") + ("f4" if kind == "f" else "f8") for kind in kinds]
    kind = {"names": list(order), "formats": formats, "offsets": [f.offset for f in fields], "itemsize": offset + end}
    records = np.full((rows, columns * (offset + end)), 0xA5, np.uint8).view(kind)
    for axis, name in enumerate("xyz"):
        records[name] = cloud[..., axis]
    padded = np.pad(records.view(np.uint8), ((0, 0), (0, row_end)), constant_values=0x5A)
    values = {
        "height": rows, "width": columns, "fields": fields, "is_bigendian": big, "point_step": offset + end,
        "row_step": padded.shape[1], "data": padded.reshape(-1), "is_dense": True,
    }  # fmt: skip
    return SimpleNamespace(**values | changed)


@pytest.mark.parametrize("order", ["xyz", "zyx"])
@pytest.mark.parametrize("kinds", ["fff", "ddd", "fdf"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("gaps", "end", "row_end"), [((0, 0, 0), 0, 0), ((4, 1, 3), 5, 7)])
def test_every_layout_gives_the_same_points(order, kinds, big, gaps, end, row_end):
    decoded = decode_points(message(points(), kinds, order, gaps, end, row_end, big))
    assert decoded.dtype == np.float64
    np.testing.assert_array_equal(decoded, points())


def test_other_fields_are_ignored_and_a_row_is_not_organised():
    packed = message(points(), gaps=(4, 0, 0), end=6)
    packed.fields += [field("intensity", 0), field("ring", 16, 4), field("x2", 0, 7, 99)]
    np.testing.assert_array_equal(decode_points(packed), points())
    for shape in ((1, 24), (24, 1)):
        cloud = points().reshape(*shape, 3)
        row_step = {"row_step": 0} if shape[0] == 1 else {}
        np.testing.assert_array_equal(decode_points(message(cloud, **row_step)), cloud.reshape(-1, 3))
    for height, width in ((0, 0), (0, 5), (5, 0)):
        assert decode_points(message(points(), height=height, width=width)).shape == (0, 3)


def test_a_row_with_one_bad_coordinate_is_nan_even_if_the_message_is_called_dense():
    cloud = points()
    cloud[0, 1, 2], cloud[2, 3, 0], cloud[3, 3, 1] = np.nan, np.inf, -np.inf
    decoded = decode_points(message(cloud))
    bad = ~np.isfinite(cloud).all(axis=-1)
    assert np.isnan(decoded[bad]).all()
    np.testing.assert_array_equal(decoded[~bad], cloud[~bad])


XYZ = [field("x", 0), field("y", 4), field("z", 8)]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"point_step": 11}, "point_step 11; expected at least 12"),
        ({"row_step": 95}, "row_step 95; expected at least 96"),
        ({"data": np.zeros(383, np.uint8)}, "data of 383 bytes; expected 384"),
        ({"height": 2**31}, "expected 206158430208"),
        ({"width": 2**31}, "row_step 96; expected at least 34359738368"),
        ({"height": -1}, "height -1"),
        ({"point_step": 2**40}, "point_step 1099511627776"),
        ({"fields": XYZ[:2]}, "fields x, y; expected one z"),
        ({"fields": [*XYZ, field("x", 12)]}, "fields x, y, z, x; expected one x"),
        ({"fields": [field("x", 0, 4), *XYZ[1:]]}, r"field x of datatype 4; expected 7 \(FLOAT32\)"),
        ({"fields": [*XYZ[:2], field("z", 8, 7, 3)]}, "field z with count 3; expected 1"),
        ({"fields": [*XYZ[:2], field("z", 2**32 - 1)]}, "point_step 16; expected at least 4294967299"),
    ],
)
def test_a_size_that_does_not_fit_is_refused_with_its_value(changed, says):
    with pytest.raises(InputError, match=says) as caught:
        decode_points(message(points(), **{"end": 4} | changed))
    assert "\n" not in str(caught.value)


number = st.integers(0, 40) | st.sampled_from([-1, 2**16, 2**31 - 1, 2**32 - 1, 2**32, 2**63])
field_st = st.builds(field, st.sampled_from(["x", "y", "z", "", "é"]), number, st.integers(0, 9), number)
values = dict.fromkeys(("height", "width", "point_step", "row_step"), number) | {
    "fields": st.lists(field_st, max_size=5), "is_bigendian": st.booleans(),
    "data": st.binary(max_size=600).map(lambda data: np.frombuffer(data, np.uint8)),
}  # fmt: skip
changes = st.sampled_from(sorted(values)).flatmap(lambda key: st.tuples(st.just(key), values[key]))


@settings(max_examples=300, deadline=None, database=None)
@given(st.booleans(), st.lists(changes, max_size=3))
def test_any_message_is_decoded_or_refused_in_bounded_memory(big, changed):
    made = message(points(), "fdf", "zxy", (4, 1, 3), 5, 7, big, **dict(changed))
    tracemalloc.start()
    try:
        with contextlib.suppress(InputError):
            decoded = decode_points(made)
            valid, invalid = np.isfinite(decoded).all(axis=-1), np.isnan(decoded).all(axis=-1)
            assert (valid ^ invalid).all()
            assert decoded.nbytes <= 2 * len(made.data)
        assert tracemalloc.get_traced_memory()[1] < 16 * len(made.data) + 200_000
    finally:
        tracemalloc.stop()
