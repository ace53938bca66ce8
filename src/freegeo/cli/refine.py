"""`freegeo refine`: a result's cameras brought to the matches between its photos, by bundle adjustment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from freegeo.cli import console
from freegeo.cli.export import find_photos, result_folder, stored_summary
from freegeo.cli.files import FORMAT_NAMES, require_complete
from freegeo.cli.jobs import say_answer, say_finished
from freegeo.cli.options import OutputOptions
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import DEFAULT_FORMATS


def refine(
    source: Path,
    *,
    output: OutputOptions,
    formats: Annotated[tuple[str, ...], FORMAT_NAMES] = DEFAULT_FORMATS,
) -> None:
    """Refine the cameras of a result by the matches between its photos, and bring its depth to them.

    Bundle adjustment, judged by matches that it did not see: where these do not fit better, nothing is written. Needs
    the extra: pip install 'freegeo[colmap]'.

    Parameters
    ----------
    source
        Folder that `run` or `reconstruct` wrote.
    """
    from freegeo.evidence.bundle import pycolmap_module
    from freegeo.export.formats import check_formats
    from freegeo.export.kept import load_kept, load_masks
    from freegeo.export.measured import save_tracks
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.files import write_json
    from freegeo.job import MATCHES_NAME, PREDICTION_NAME, SUMMARY_NAME, UNREFINED_FOLDER, write_files
    from freegeo.lock import kept_still
    from freegeo.models.checkpoints import fingerprint
    from freegeo.refined import refine_by_photos
    from freegeo.report.contents import FILES
    from freegeo.report.page import write_report
    from freegeo.run_folder import run_folder

    pycolmap_module()
    run = result_folder(source)
    if run == output.output.resolve():
        raise UserError(f"{output.output}: holds the result that is to be refined. Choose another folder (--output).")
    with kept_still(run):
        before = Reconstruction.load(source)
        names = check_formats(formats, before.names, has_cameras=before.has_cameras)
        summary = stored_summary(source)
        if summary["refinement"].get("accepted"):
            raise UserError(f"{source}: is refined already.")
        if summary.get("known_cameras"):
            raise UserError(f"{source}: its cameras are known ones, which are not to be moved.")
        photos = find_photos(before, source)
        if photos is None:
            raise UserError(f"{source}: its photos are not where they were, or have changed; matches need them.")
        settings = {
            "command": "refine", "source": str(source.resolve()), "prediction": fingerprint(source / PREDICTION_NAME),
            "formats": names,
        }  # fmt: skip
        with run_folder(output.output, settings, overwrite=output.overwrite) as folder:
            if folder.finished:
                say_finished(output.output, folder.finished_at)
                return
            console.note("matches between the photos, and bundle adjustment ...")
            found = refine_by_photos(before, photos, store=folder / MATCHES_NAME)
            if found.tracks is None:
                raise FreeGeoError(f"{source}: not refined, nothing is written. {found.about['reason']}")
            before.save(folder / UNREFINED_FOLDER)
            save_tracks(folder.path, found.tracks)
            found.result.save(folder.path)
            masks = None if load_kept(source, before.depth_z.shape) is None else load_masks(source)
            filters, failed = write_files(folder.path, found.result, names, masks=masks, photos=photos)
            told = {
                "frozen_prediction": None, "refinement": found.about, "not_written": dict(failed),
                "filters": None if filters is None else {"pixels": filters.pixels, "removed": dict(filters.removed)},
                "command": console.command_line(), "verdict": None, "loss": None, "rejected_adapter": None,
                "warnings": list(dict.fromkeys([*summary["warnings"], *console.warned()])),
            }  # fmt: skip
            summary = {**summary, **told}
            write_json(folder / SUMMARY_NAME, summary)
            write_report(folder.path, photos=photos)
            folder.finish()
    say_answer(summary)
    console.written(output.output, FILES)
    require_complete(output.output, failed)
