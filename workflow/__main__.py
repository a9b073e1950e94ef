"""`python -m workflow`: commands behind `make reproduce`, `make smoke`, `make check`, `make bits` and `make docs`.

Exit code 0: done; 1: a notebook failed, or a result differs; 2: bad input; 130: interrupted.
"""

import difflib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from steelnb.core.errors import InputError
from steelnb.core.files import new_folder
from steelnb.core.terminal import call
from steelnb.notebook.results import find_root
from workflow.experiments import BUDGETS, first_parts, make_parts, parse_parameters
from workflow.run_notebooks import LATEST, cache_folder, latest_parts, run
from workflow.write_results import write

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, help=__doc__)
Ids = Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="Experiments. Default: all but those apart.")]
Budget = Annotated[str, typer.Option(help="full, or smoke: a short run of every method.")]
Jobs = Annotated[int, typer.Option(min=1, help="Notebooks run in parallel.")]


@app.command()
def reproduce(
    ids: Ids = None,
    budget: Budget = "full",
    parameters: Annotated[str, typer.Option("-p", metavar="'NAME=VALUE ...'", help="Parameters; need --output.")] = "",
    output: Annotated[Path | None, typer.Option(help="Folder for <id>/; default: results or results-smoke.")] = None,
    jobs: Jobs = 2,
) -> int:
    """Run the notebooks that are not up to date, and write metrics, tables and figures to <output>/<id>/."""
    root, given = find_root(), parse_parameters(parameters)
    parts = make_parts(root, ids or [], budget, given)
    folder, full = (output or root / BUDGETS[budget]).resolve(), (root / BUDGETS["full"]).resolve()
    if (given or budget != "full") and folder.is_relative_to(full):
        raise InputError(f"OUT={folder}: expected a folder outside {full}, which holds the default results")
    with new_folder(folder):
        pass  # raises if nothing can be written there
    return write(parts, folder, cache_folder(root, folder), root / ".cache", budget, jobs)


@app.command()
def check(ids: Ids = None, jobs: Jobs = 2) -> int:
    """Run the notebooks from scratch in .cache/check/, and compare metrics and tables with the last commit."""
    root = find_root()
    parts, cache = make_parts(root, ids or [], "full"), root / ".cache" / "check"
    ids = list(dict.fromkeys(part.id for part in parts))
    names = [f"{id}/{name}" for id in ids for name in ("metrics.json", "table.csv")]
    before = {name: committed(root, f"results/{name}") for name in names}
    shutil.rmtree(cache, ignore_errors=True)
    if code := write(parts, cache / "results", cache, cache / "arrays", "full", jobs):
        return code
    differ = 0
    for name, old in before.items():
        new = (cache / "results" / name).read_text(encoding="utf-8")
        differ += old != new
        pair = old.splitlines(), new.splitlines()
        for line in difflib.unified_diff(*pair, f"{name}, committed", f"{name}, now", n=0, lineterm=""):
            print(line)
    print(f"{differ} of {len(before)} files of metrics and tables differ from the last commit")
    return int(differ > 0)


def committed(root: Path, path: str) -> str:
    """Text of a file at the last commit, or in the tree if there is no git. Raises `InputError`."""
    shown = subprocess.run(["git", "show", f"HEAD:./{path}"], cwd=root, capture_output=True, text=True, check=False)
    try:
        return (root / path).read_text(encoding="utf-8") if shown.returncode else shown.stdout
    except OSError:
        raise InputError(f"{path}: nothing to compare; run `make reproduce` first") from None


@app.command()
def digests(
    rewrite: Annotated[bool, typer.Option("--write", help="Rewrite tests/digests.json.")] = False,
    short: Annotated[bool, typer.Option("--short", help="Print the set that `bits` emulates.")] = False,
    full: Annotated[bool, typer.Option("--full", help="Print the whole set.")] = False,
) -> int:
    """Compute the digests of short flights and list those that differ from the last commit."""
    from workflow import digests as of

    root = find_root()
    found = of.compute(of.SHORT if short else of.SETTINGS)
    if short or full:
        print(json.dumps(found))
        return 0
    if rewrite:
        of.write(root, found)
        return 0
    old = of.read(root)
    differ = of.changed(old, found)
    for name in differ:
        print(f"changed: {name}: {old.get(name, 'missing')}, now {found.get(name, 'missing')}")
    print(f"{len(differ)} of {len(found)} digests changed")
    return int(bool(differ))


@app.command()
def kernels() -> int:
    """Compile the kernels that notebooks, commands and tests need, into the package's cache."""
    from workflow.kernels import compile_kernels

    compile_kernels()
    return 0


@app.command()
def bits() -> int:
    """Compute the digests as other processors would, natively and emulated, and print a table."""
    from workflow.digests import bits

    return 0 if bits(find_root()) else 1


@app.command()
def pages(
    budget: Annotated[str, typer.Option(help="full or smoke. Default: full where up to date, else smoke.")] = "",
    jobs: Jobs = 2,
) -> int:
    """Run the first part of every notebook, including those apart, if it is not up to date.

    The executed notebooks and Plotly's script go to docs/notebooks/ and docs/_static/, where Sphinx reads them.
    """
    from workflow.pages import write_pages

    root = find_root()
    parts = first_parts(root, budget) if budget else latest_parts(root)
    cache = cache_folder(root, root / BUDGETS.get(budget, LATEST))
    for fault in filter(None, run(parts, cache, root / ".cache", jobs).values()):
        raise fault
    write_pages(parts, cache, root / "docs")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return call(app, "workflow", arguments)


if __name__ == "__main__":
    sys.exit(main())
