"""A term of your own in the loss of the adaptation: `freegeo.adapt(..., own_loss=function)`.

The term here compares how features change from patch to patch, as a gradient-matching loss does for depth maps: the
student, which sees half of the views, is to have the edges of the teacher, which sees all of them.
Runs on a generated room with the embedded model; `--photos` and `--model` take yours.
"""

import argparse
from pathlib import Path

import torch

import freegeo
from freegeo.types import Features

WEIGHT = 0.1


def edges_of_features(student: Features, teacher: Features) -> torch.Tensor:
    """Return the mean difference between the edges of both, at the highest layer that the losses read.

    Features have levels: layer -> (patches (1, views, rows * columns, channels), special tokens), of the views that the
    student sees. The teacher's have no gradient. The frozen heads can read them too: `model.decode(student)`.
    """
    layer = max(student.levels)
    ours, theirs = (one.levels[layer][0].float().unflatten(2, student.grid_hw) for one in (student, teacher))
    differences = [ours.diff(dim=axis) - theirs.diff(dim=axis) for axis in (2, 3)]
    return WEIGHT * sum(one.abs().mean() for one in differences)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", help="a folder or a video; default: a generated room")
    parser.add_argument("--model", default="freegeo-tiny", help="see `freegeo models`")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/own-loss"), help="folder for the adapter")
    arguments = parser.parse_args()
    photos = freegeo.load_photos(arguments.photos or generated())
    model = freegeo.load_model(arguments.model)
    result = freegeo.adapt(model, photos, steps=arguments.steps, own_loss=edges_of_features, progress=True)
    result.save(arguments.output)  # freegeo.json says which term took part
    for step in (0, -1):
        terms = result.curve[step]
        print(f"step {range(len(result.curve))[step]}: total {terms['total']:.4f}, of it own {terms['own']:.4f}")
    print(result.trouble or result.verdict["reason"])


def generated():
    from freegeo.data.procedural import photograph_room

    return list(photograph_room(20_000_001, "test-id", frames=8).photos)


if __name__ == "__main__":
    main()
