"""The results of the parts of an experiment → its result folder."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from steelnb.files import new_folder
from steelnb.results import RESULTS, pictures, result_files, write_json


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each result file; of timing.csv only that it is there, since measured times always differ."""
    return {
        path.name: "" if path.name == "timing.csv" else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in result_files(folder)
    }


def merge(parts: Mapping[str, Path], target: Path, about: Mapping[str, Any]) -> None:
    """Make one result of the results of the parts (name → folder, in order). Raises `OutputError`.

    Tables are joined, metrics are prefixed ``<part>.``, figures and structures suffixed ``_<part>``, and ``about`` is
    added to provenance.json. The single part of an experiment is named ``all`` and leaves no prefix.
    """
    import pandas as pd  # heavy, and a second call needs none

    metrics: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    with new_folder(target, stale=RESULTS) as folder:
        for part, source in parts.items():
            name = "" if part == "all" else part
            values = json.loads((source / "metrics.json").read_text(encoding="utf-8"))
            metrics.update({f"{name}.{key}" if name else key: value for key, value in values.items()})
            provenance[part] = json.loads((source / "provenance.json").read_text(encoding="utf-8"))
            for path in pictures(source):
                shutil.copyfile(path, folder / (f"{path.stem}_{name}{path.suffix}" if name else path.name))
        for file in ("table.csv", "timing.csv"):
            tables = [source / file for source in parts.values() if (source / file).is_file()]
            if tables:  # the text of the cells is kept
                joined = pd.concat([pd.read_csv(table, dtype=str, keep_default_na=False) for table in tables])
                joined.to_csv(folder / file, index=False, lineterminator="\n")
        write_json(folder / "metrics.json", metrics)
        write_json(folder / "provenance.json", {**about, "parts": provenance})
