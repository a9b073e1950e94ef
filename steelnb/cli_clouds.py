"""The commands `steelnb segment` and `steelnb structure`."""

from pathlib import Path
from typing import Annotated

import typer

from steelnb.cli_options import examples, output_option
from steelnb.cli_progress import progress
from steelnb.errors import SettingsError

app = typer.Typer()


@app.command(epilog=examples("steelnb segment tower.ply", "steelnb segment tower.laz --dx 0.08 -o bars"))
def segment(
    cloud: Annotated[Path, typer.Argument(help="PLY, PCD, LAS, LAZ, NPY, XYZ, TXT, CSV, PTS or ASC file.")],
    output: Annotated[Path | None, output_option("For bars, joints and a picture.", "NAME_segments here")] = None,
    voxel: Annotated[float | None, typer.Option(help="Voxel size in metres; default: from the point spacing.")] = None,
    dx: Annotated[
        float | None, typer.Option(help="Radius of a bar's tube of points in metres; default: from the point spacing.")
    ] = None,
    min_votes: Annotated[int | None, typer.Option(help="Fewest points of a line.")] = None,
    structure: Annotated[bool, typer.Option(help="Write structure.json too: bars tied at joints.")] = True,
) -> None:
    """Find the straight bars in a point cloud.

    And the joints that tie them.
    """
    with progress() as shown:
        from steelnb.report.cloud import segment_file

        shown.show(f"finding bars in {cloud.name}")
        result = segment_file(cloud, output, voxel_m=voxel, dx_m=dx, min_votes=min_votes, structure=structure)
    print("\n".join(result.summary))


@app.command(
    epilog=examples(
        "steelnb structure bars/structure.json",
        "steelnb structure before.json after.json -o differences",
        "steelnb structure bars/structure.json --to tower.dxf",
        codes="0 done, and two structures equal; 1 they differ; 2 bad input, nothing written; 130 interrupted.",
    )
)
def structure(
    first: Annotated[Path, typer.Argument(metavar="A.json", help="A structure as steelnb wrote it.")],
    second: Annotated[Path | None, typer.Argument(metavar="[B.json]", help="Another one, in the same frame.")] = None,
    output: Annotated[
        Path | None, output_option("For differences.csv and differences.png.", "none are written")
    ] = None,
    to: Annotated[
        Path | None, typer.Option("--to", help="Write A to this file: .json, .csv, .dxf, .glb or .ifc.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Let --to overwrite.")] = False,
    offset: Annotated[float | None, typer.Option(help="Metres up to which an axis has not moved.")] = None,
    angle: Annotated[float | None, typer.Option(help="Degrees up to which it has not turned.")] = None,
    end: Annotated[float | None, typer.Option(help="Metres up to which its ends have not moved.")] = None,
    joint: Annotated[float | None, typer.Option(help="Metres up to which a joint has not moved.")] = None,
) -> None:
    """Describe, compare or convert structures.

    One is described, or converted with --to; two are compared. Tolerances are by default those of
    steelnb.settings.Tolerance.
    """
    from steelnb.report.structure_files import compare_files, convert_file, describe_file
    from steelnb.settings import Tolerance

    if second is None and output is not None:
        raise SettingsError("--output: expected two structures to compare; --to FILE converts one")
    if second is not None and to is not None:
        raise SettingsError("--to: expected one structure to convert, not two")
    if second is not None:
        given = {"offset_m": offset, "angle_deg": angle, "end_m": end, "joint_m": joint}
        limit = Tolerance(**{name: value for name, value in given.items() if value is not None})
        report = compare_files(first, second, output, limit)
        print("\n".join(report.summary))
        raise typer.Exit(0 if report.comparison.equal else 1)
    if to is not None:
        for file in convert_file(first, to, overwrite=force):
            print(f"{file} written")
        return
    print("\n".join(describe_file(first)))
