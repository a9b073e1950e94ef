"""An .rrd file read back by rerun's own reader."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np


def read_rrd(path: Path) -> dict[str, list[tuple[float | None, Any]]]:
    """By ``entity`` and component, as ``/world/scan:positions``: the time in seconds (None: always) and the values of
    each row, in order."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[tuple[float | None, Any]]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        stamps: list[float | None] = [None] * chunk.num_rows
        if not chunk.is_static:
            column = batch.column("stamp")
            stamps = (np.asarray(column.cast("int64")) / 1e9).tolist()
        for name in batch.schema.names:
            if ":" in name:
                values = batch.column(name).to_pylist()
                rows[f"{chunk.entity_path}:{name.partition(':')[2]}"] += zip(stamps, values, strict=True)
    return {name: sorted(of, key=lambda row: (row[0] is not None, row[0])) for name, of in rows.items()}
