"""PointCloud2: any layout gives the same points; whatever does not fit together is refused, cheaply."""

import contextlib
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steelnb.errors import FileContentError
from steelnb.recordings.bag_files import typestore
from steelnb.recordings.bag_writer import Messages
from steelnb.recordings.pointcloud2 import PointCloud2, PointField, decode_points, encode_points
from steelnb.recordings.topics import CLOUD


def points(rows: int = 4, columns: int = 6) -> np.ndarray:
    cloud = np.random.default_rng(0).normal(size=(rows, columns, 3)).astype(np.float32).astype(np.float64)
    cloud[1, 2] = np.nan
    return cloud


def message(
    cloud: np.ndarray, kinds: str = "fff", order: str = "xyz", gaps=(0, 0, 0), end: int = 0, row_end: int = 0, big=False
) -> PointCloud2:
    """A message made byte by byte: ``kinds`` f or d of each field in ``order``, with ``gaps`` bytes before each."""
    prefix = ">" if big else "<"
    fields, offset = [], 0
    for name, kind, gap in zip(order, kinds, gaps, strict=True):
        offset += gap
        fields.append(PointField(name, offset, 7 if kind == "f" else 8))
        offset += 4 if kind == "f" else 8
    rows, columns = cloud.shape[:2]
    data = bytearray()
    for row in cloud:
        for point in row:
            record = bytearray(b"\xa5" * (offset + end))
            for field, kind in zip(fields, kinds, strict=True):
                number = np.array(point["xyz".index(field.name)], prefix + ("f4" if kind == "f" else "f8")).tobytes()
                record[field.offset : field.offset + len(number)] = number
            data += record
        data += b"\x5a" * row_end
    step = offset + end
    raw = np.frombuffer(bytes(data), np.uint8)
    return PointCloud2(rows, columns, tuple(fields), big, step, columns * step + row_end, raw, False)


@pytest.mark.parametrize("order", ["xyz", "zyx", "yxz"])
@pytest.mark.parametrize("kinds", ["fff", "ddd", "fdf"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("gaps", "end", "row_end"), [((0, 0, 0), 0, 0), ((4, 1, 3), 5, 7)])
def test_every_layout_gives_the_same_points(order, kinds, big, gaps, end, row_end):
    cloud = points()
    decoded = decode_points(message(cloud, kinds, order, gaps, end, row_end, big))
    assert decoded.dtype == np.float64
    np.testing.assert_array_equal(decoded, cloud)


def test_other_fields_lie_between():
    cloud = points()
    packed = message(cloud, gaps=(4, 0, 0), end=6)
    others = (PointField("intensity", 0, 7), PointField("ring", 16, 4), PointField("x2", 0, 7, 99))
    np.testing.assert_array_equal(decode_points(replace(packed, fields=(*others, *packed.fields))), cloud)


@pytest.mark.parametrize("shape", [(1, 24), (24, 1)])
def test_a_single_row_or_column_is_not_organised(shape):
    cloud = points().reshape(*shape, 3)
    np.testing.assert_array_equal(decode_points(message(cloud)), cloud.reshape(-1, 3))


def test_the_row_step_of_a_single_row_does_not_matter():
    cloud = points().reshape(1, 24, 3)
    np.testing.assert_array_equal(decode_points(replace(message(cloud), row_step=0)), cloud[0])


def test_a_row_with_one_bad_coordinate_is_nan_even_if_the_message_is_called_dense():
    cloud = points()
    cloud[0, 1, 2], cloud[2, 3, 0], cloud[3, 3, 1] = np.nan, np.inf, -np.inf
    decoded = decode_points(replace(message(cloud), is_dense=True))
    bad = ~np.isfinite(cloud).all(axis=-1)
    assert np.isnan(decoded[bad]).all()
    np.testing.assert_array_equal(decoded[~bad], cloud[~bad])


@pytest.mark.parametrize("size", [(0, 0), (0, 5), (5, 0)])
def test_a_cloud_of_no_points_is_empty(size):
    height, width = size
    assert decode_points(replace(message(points()), height=height, width=width)).shape == (0, 3)


def changed(**values) -> PointCloud2:
    return replace(message(points(), end=4), **values)


def with_field(k: int, **values) -> PointCloud2:
    base = changed()
    fields = list(base.fields)
    fields[k] = replace(fields[k], **values)
    return replace(base, fields=tuple(fields))


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (changed(point_step=11), "point_step 11; expected at least 12"),
        (changed(row_step=95), "row_step 95; expected at least 96"),
        (changed(data=np.zeros(383, np.uint8)), "data of 383 bytes; expected 384"),
        (changed(height=2**31), "expected 206158430208"),
        (changed(width=2**31), "row_step 96; expected at least 34359738368"),
        (changed(height=-1), "height -1"),
        (changed(point_step=2**40), "point_step 1099511627776"),
        (changed(fields=changed().fields[:2]), "fields x, y; expected one z"),
        (changed(fields=(*changed().fields, PointField("x", 12, 7))), "fields x, y, z, x; expected one x"),
        (with_field(1, offset=2), "do not overlap"),
        (with_field(1, offset=0), "do not overlap"),
        (with_field(0, datatype=4), "field x of datatype UINT16; expected FLOAT32 or FLOAT64"),
        (with_field(2, datatype=99), "field z of datatype 99"),
        (with_field(2, count=3), "field z with count 3; expected 1"),
        (with_field(2, offset=2**32 - 1), "point_step 16; expected at least 4294967299"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_value(bad, says):
    with pytest.raises(FileContentError, match=says) as caught:
        decode_points(bad)
    assert "\n" not in str(caught.value)


def test_encoding_keeps_what_single_precision_can_hold():
    cloud = np.random.default_rng(2).uniform(-6, 6, size=(5, 7, 3))
    cloud[2, 2] = np.nan
    encoded = encode_points(cloud)
    assert (encoded.height, encoded.width, encoded.is_dense) == (5, 7, False)
    np.testing.assert_allclose(decode_points(encoded), cloud, rtol=6e-8)
    assert encode_points(cloud[0]).height == 1
    assert encode_points(cloud[0]).is_dense


BASES = [
    message(points(), "fff"),
    message(points(3, 5), "ddd", "zyx", (4, 1, 3), 5, 7, True),
    message(points().reshape(1, 24, 3), "fdf"),
    message(points(), gaps=(8, 0, 0)),
]
number = st.integers(0, 40) | st.sampled_from([-1, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**63])
names = st.sampled_from(["x", "y", "z", "", "intensity", "é"])
field_values = {"name": names, "offset": number, "datatype": st.integers(0, 9), "count": number}
message_values = dict.fromkeys(("height", "width", "point_step", "row_step"), number) | {
    "fields": st.lists(st.builds(PointField, **field_values), max_size=5).map(tuple),
    "is_bigendian": st.booleans(),
    "data": st.binary(max_size=600),
}
some_changes = st.sampled_from(sorted(message_values)).flatmap(lambda key: st.tuples(st.just(key), message_values[key]))
field_change = st.sampled_from(sorted(field_values)).flatmap(lambda key: st.tuples(st.just(key), field_values[key]))


@pytest.mark.slow
@settings(max_examples=5500, deadline=None, database=None)
@given(st.sampled_from(BASES), st.lists(some_changes, max_size=3), st.integers(0, 2), st.none() | field_change)
def test_any_message_is_decoded_or_refused(base, changes, k, field):
    made = replace(base, **dict(changes))
    if field and k < len(made.fields):
        made = replace(made, fields=(*made.fields[:k], replace(made.fields[k], **dict([field])), *made.fields[k + 1 :]))
    _bounded(lambda: decode_points(made), len(made.data))


RAW = {
    ros: bytes(
        (store.serialize_ros1 if ros == 1 else store.serialize_cdr)(Messages(ros).cloud(5 * 10**9, points()), CLOUD)
    )
    for ros, store in ((1, typestore(1)), (2, typestore(2)))
}
place = st.floats(0, 1, exclude_max=True)


@pytest.mark.slow
@settings(max_examples=5500, deadline=None, database=None)
@given(st.sampled_from([1, 2]), st.lists(st.tuples(place, st.integers(0, 255)), max_size=4), place, st.booleans())
def test_any_damaged_message_is_decoded_or_refused(tmp_bag, ros, changes, cut, whole):
    raw = bytearray(RAW[ros])
    for where, value in changes:
        where = where**3  # the header, with all that can go wrong, is in front
        raw[int(where * len(raw))] = value
    if not whole:
        del raw[int(cut * len(raw)) :]
    _bounded(lambda: tmp_bag[ros](bytes(raw)), len(raw))


@pytest.fixture(scope="module")
def tmp_bag(tmp_path_factory):
    """Decoders of raw messages as they lie in a bag of ROS 1 and of ROS 2."""
    from steelnb.recordings.bag_files import Bag, Message
    from tests.recordings.bag_samples import write_rows

    decoders = {}
    for ros, ending in ((1, ".bag"), (2, ".mcap")):
        path = write_rows(tmp_path_factory.mktemp("raw") / f"a{ending}", [("/points", CLOUD, 5.0, RAW[ros])])
        bag = Bag(path)
        decoders[ros] = lambda raw, bag=bag: decode_points(bag.decode(Message("/points", 0, memoryview(raw))))
    return decoders


def _bounded(decode, size: int) -> None:
    """Decodes or raises ours, and takes no more memory than some times the size of the message."""
    tracemalloc.start()
    try:
        with contextlib.suppress(FileContentError):
            decoded = decode()
            valid, invalid = np.isfinite(decoded).all(axis=-1), np.isnan(decoded).all(axis=-1)
            assert (valid ^ invalid).all()
            assert decoded.nbytes <= 2 * size
        assert tracemalloc.get_traced_memory()[1] < 16 * size + 200_000
    finally:
        tracemalloc.stop()
