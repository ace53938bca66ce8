"""`freegeo refine`: a result's cameras brought to the matches between its photos, by bundle adjustment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from freegeo.cli import console
from freegeo.cli.export import find_photos
from freegeo.cli.files import FORMAT_NAMES, require_complete
from freegeo.cli.jobs import FILES, say_finished
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
    from freegeo.evidence.refinement import bring_depth
    from freegeo.evidence.refinement import refine as refined_by
    from freegeo.export.formats import check_formats, export, filter_reconstruction
    from freegeo.export.kept import load_kept, load_masks, save_kept
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.files import read_json, write_json
    from freegeo.guarded import scene_matches
    from freegeo.models.checkpoints import fingerprint
    from freegeo.pipeline import MATCHES_NAME, PREDICTION_NAME, SUMMARY_NAME
    from freegeo.report.page import write_report
    from freegeo.run_folder import run_folder

    pycolmap_module()
    before = Reconstruction.load(source)
    names = check_formats(formats, before.names, has_cameras=before.has_cameras)
    summary = read_json(source / SUMMARY_NAME) if (source / SUMMARY_NAME).is_file() else {}
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
        console.note("matches between the photos ...")
        matches = scene_matches(photos, before, folder / MATCHES_NAME)
        console.note("bundle adjustment ...")
        found = refined_by(before, matches)
        if not found.accepted:
            raise FreeGeoError(f"{source}: not refined, nothing is written. {found.reason}")
        after, _ = bring_depth(before, found)
        after.save(folder.path)
        known = load_kept(source, before.depth_z.shape)
        masks = None if known is None else load_masks(source)
        filtered = filter_reconstruction(after, masks=masks)
        save_kept(folder.path, filtered, masks)
        exported = export(after, folder.path, names, filtered=filtered, masks=masks, photos=photos)
        told = {
            "frozen_prediction": None, "filters": {"pixels": filtered[1].pixels, "removed": dict(filtered[1].removed)},
            "not_written": dict(exported.failed), "command": console.command_line(), "verdict": None, "loss": None,
            "warnings": list(dict.fromkeys([*summary.get("warnings", []), *console.warned()])),
            "refinement": {"source": str(source), "reason": found.reason, "probability": found.probability},
        }  # fmt: skip
        write_json(folder / SUMMARY_NAME, {**summary, **told})
        write_report(folder.path)
        folder.finish()
    console.say(found.reason)
    console.written(output.output, FILES)
    require_complete(output.output, exported.failed)
