"""Checks of the files that a notebook reads: they are what it expects, and hold what its other parameters select."""

from collections.abc import Mapping
from typing import Any

from steelnb.core.checks import checked_choice
from steelnb.core.errors import InputError
from steelnb.notebook.results import find_root

READ_NAMES = "study_folder", "frames_folder", "starts_folder", "claims_file"
"""Parameters that name a file or folder to read."""
_FLIGHTS = "trajectory in ['zigzag', 'loops']"
_SENSORS = "sensor.str.startswith('starling2')"
SELECTED = {
    "method": ("method", "status == 'ok'"),
    "methods": (
        "method",
        f"{_FLIGHTS} and {_SENSORS} and duration_s == 200 and variant == '' and noise == 'random-walk'",
    ),
    "noise": ("noise", f"{_FLIGHTS} and sensor == 'starling2' and variant in ['', 'blind']"),
}
"""Parameter of notebooks 08 and 10 → the column of the study that it selects by, and the rows that it selects from."""
_HONEST = "status == 'ok' and sensor == 'starling2-honest' and duration_s == 200 and noise == 'random-walk'"
_CAUSES = "trajectory == 'zigzag'", "trajectory == 'loops'", *(
    f"variant == {name!r}" for name in ("", "calibrated", "no multipath", "no multipath, no bias")
)  # fmt: skip
NEEDED = {
    "methods": (SELECTED["methods"][1],),
    "claims_file": (
        "sensor == 'report' and duration_s in [200, 240] and variant == '' and method.str.startswith('report-')"
        " and noise in ['random-walk', 'constant-drift']",
    ),
    "trajectory": (
        f"{_HONEST} and method == 'smoothed'",
        *(f"{_HONEST} and method in ['faces', 'smoothed'] and {each}" for each in _CAUSES),
    ),
}
"""The first of these parameters that a notebook has tells which it is: 10, 12 or 09 → rows that its study must have."""


def check_source(name: str, values: Mapping[str, Any]) -> None:
    """Raise `InputError` if a notebook cannot read what one of its `READ_NAMES` names, if a study has no row that it
    needs (`NEEDED`), and if another parameter selects no row of a study that has rows to select from. A study may lack
    whole parts."""
    from steelnb.notebook import basin, claims, single_frames, study

    readers: Mapping[str, Any] = {
        "study_folder": study.read_runs, "frames_folder": single_frames.frame_runs,
        "starts_folder": basin.start_runs, "claims_file": claims.read_claims,
    }  # fmt: skip
    try:
        found = readers[name](find_root() / values[name])
    except InputError as fault:
        raise InputError(f"{name} = {values[name]!r}: {fault}") from None
    for rows in next((NEEDED[each] for each in NEEDED if each in values), ()) if name == "study_folder" else ():
        if found.query(rows).empty:
            raise InputError(f"{name} = {values[name]!r}: it has no run with {rows}")
    for chosen, (column, rows) in SELECTED.items() if name == "study_folder" else ():
        if chosen in values:
            known = sorted(found.query(rows)[column].unique())
            found = found[found[column].isin(values[chosen])]
            if known and found.query(rows).empty:
                checked_choice(values[chosen][0], chosen, known)
