"""Photos in, a folder out that trainers of Gaussian splats read as it is: images/, sparse/0/ in PINHOLE, README.txt.

    python examples/photos_to_colmap_gsplat.py photos/ -o splats/ --model da3-base

Shows `load_photos`, `adapt`, `reconstruct`, `refine` and the COLMAP export (`pip install 'freegeo[colmap]'`).
Without photos, a generated room is used with the embedded model: that shows the steps, and is no scene for splats.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import freegeo

README = """images/    upright copies of the photos, which the cameras belong to
sparse/0/  cameras (PINHOLE), images and points in COLMAP's format

gsplat's example trainer (photos are full size, so its factor is 1):
    python examples/simple_trainer.py default --data_dir {folder} --data_factor 1 --result_dir splats

The reference implementation of 3D Gaussian splatting:
    python train.py --source_path {folder} --model_path splats

nerfstudio:
    ns-train splatfacto --data {folder} colmap --colmap-path sparse/0 --images-path images --downscale-factor 1
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="*", help="a folder, a video, or files; default: a generated room")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/gsplat"))
    parser.add_argument("--model", default="freegeo-tiny", help="see `freegeo models`")
    parser.add_argument("--steps", type=int, default=5, help="of the adaptation; 0: the frozen model; 100 is usual")
    arguments = parser.parse_args()
    if arguments.output.exists():
        parser.error(f"{arguments.output} exists; name another folder")

    photos = freegeo.load_photos(source(arguments.photos))
    model = freegeo.load_model(arguments.model)
    if arguments.steps:
        adapted = freegeo.adapt(model, photos, steps=arguments.steps)
        print(adapted.trouble or adapted.verdict["reason"])
    result = freegeo.reconstruct(model, photos)
    refined = freegeo.refine(result, photos)  # where the matches prove it; else the cameras as they were
    print(refined.about["reason"])

    with tempfile.TemporaryDirectory() as scratch:
        refined.result.export(scratch, ["colmap"], photos=photos)
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(Path(scratch) / "colmap", arguments.output)
    (arguments.output / "README.txt").write_text(README.format(folder=arguments.output.resolve()), encoding="utf-8")
    print((arguments.output / "README.txt").read_text(encoding="utf-8"))


def source(photos: list[str]):
    """Return what `load_photos` takes: what was named, or the photos of a generated room."""
    if photos:
        return photos[0] if len(photos) == 1 else photos
    from freegeo.data.procedural import photograph_room

    return list(photograph_room(20_000_001, "test-id", frames=8).photos)


if __name__ == "__main__":
    main()
