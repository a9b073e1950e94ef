"""`make gallery`: every notebook as executed → one folder of pages that need nothing but a browser.

Each page holds its own pictures, style and, where there is a 3D view, Plotly: no page asks for anything, online or off.
"""

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from steelnb import reproduce
from steelnb.errors import NotebookError
from steelnb.gallery.page import MARK, Card, index_html, page_html, read_page
from steelnb.project import RESULT_FOLDERS, Part, Project

THUMBNAIL_PX = 720

__all__ = ["Report", "make"]


@dataclass(frozen=True)
class Report:
    """The first page, the pages behind it, and the experiments without one, since they run only when they are named."""

    index: Path
    pages: list[Path]
    missing: list[str]


def make(
    ids: Iterable[str] = (),
    budget: str = "full",
    output: Path | None = None,
    jobs: int = 2,
    *,
    on_progress: reproduce.OnProgress | None = None,
    root: Path | None = None,
) -> Report:
    """Write a page for every part of the experiments named (default: all), and an index, into the folder ``output``.

    What is not up to date is run first, as by `reproduce.run`; at the full budget, an experiment that is apart has
    pages only if it is named or was run before. ``output`` is by default ``gallery`` in the project; files in it that
    are no pages of a gallery stay. Raises what `reproduce.run` raises, and `OutputError`.
    """
    from steelnb.recordings import new_folder

    project, ids = Project(root), list(ids)
    target = output or project.root / "gallery"
    found = _run(project, ids, budget, jobs, on_progress)
    executed = {name: [(part, path) for part, path in parts if path] for name, parts in found.items()}
    shown = {name: parts for name, parts in executed.items() if len(parts) == len(found[name])}
    experiments = project.select(ids)
    links = {e.notebook: page_name(shown[e.id][0][0]) for e in experiments if e.id in shown}
    names = ["index.html"]
    with new_folder(target) as folder:
        cards = []
        for experiment in experiments:
            parts = shown.get(experiment.id, [])
            siblings = {part.name or "open": page_name(part) for part, _ in parts}
            lead = ""
            for part, path in parts:
                page = read_page(path, links)
                lead = lead or page.lead
                title = f"{experiment.title}: {part.name}" if part.name else experiment.title
                names.append(page_name(part))
                (folder / names[-1]).write_text(page_html(page, title, siblings, names[-1]), encoding="utf-8")
            picture = _thumbnail(project.root / RESULT_FOLDERS[budget] / experiment.id)
            cards.append(Card(experiment.id, experiment.title, experiment.about or lead, picture, siblings))
        (folder / "index.html").write_text(index_html(cards), encoding="utf-8")
    for path in target.glob("*.html"):
        if path.name not in names and MARK in path.read_text(encoding="utf-8", errors="replace")[:1000]:
            path.unlink()
    missing = [name for name in found if name not in shown]
    return Report(target / "index.html", [target / name for name in names[1:]], missing)


def page_name(part: Part) -> str:
    """The file of a part's page."""
    return f"{part.label.replace('/', '-')}.html"


Found = dict[str, list[tuple[Part, Path | None]]]
"""By experiment: its parts, each with its notebook as executed, None where that is not up to date."""


def _run(project: Project, ids: list[str], budget: str, jobs: int, on_progress: reproduce.OnProgress | None) -> Found:
    """What there is after everything was run that is missing and not apart."""
    daily = [experiment.id for experiment in project.select(ids, apart=budget == "smoke")]
    if daily:
        reproduce.run(daily, budget, jobs=jobs, on_progress=on_progress, root=project.root)
    found = _find(project, ids, budget)
    # Results that are up to date, but whose notebooks as executed were cleared away.
    lost = [name for name in daily if not _complete(found[name])]
    if lost:
        reproduce.run(lost, budget, jobs=jobs, force=True, on_progress=on_progress, root=project.root)
        found = _find(project, ids, budget)
    for name in lost:
        if not _complete(found[name]):
            raise NotebookError(f"{name}: notebook or code was edited while it ran; make the gallery again")
    return found


def _find(project: Project, ids: list[str], budget: str) -> Found:
    found: Found = {}
    for part, path in reproduce.executed(ids, budget, project.root):
        found.setdefault(part.experiment, []).append((part, path))
    return found


def _complete(parts: list[tuple[Part, Path | None]]) -> bool:
    return all(path is not None for _, path in parts)


def _thumbnail(results: Path) -> str:
    """The first figure of a result folder, small, as a data address; empty where there is none."""
    from PIL import Image

    figure = next(iter(sorted(results.glob("fig_*.png"))), None)
    if figure is None:
        return ""
    file = io.BytesIO()
    with Image.open(figure) as image:
        small = image.convert("RGB")
        small.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
        small.save(file, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
