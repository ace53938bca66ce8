"""An output folder as a run writes it: a generated room whose prediction before adaptation is worse than after."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from exact_rooms import room
from freegeo import files
from freegeo.data.photos import MemoryPhoto
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.rotation import quat_xyzw_to_matrix
from freegeo.geometry.se3 import camera_centres, from_Rt
from freegeo.geometry.sim3 import Sim3

HOSTILE_NAME = '"><script>window.broken=1</script> & <b>.jpg'


def disturbed(exact: Reconstruction, amount: float, seed: int, *, scale: float = 1.0) -> Reconstruction:
    """A prediction with smooth depth errors, turned and shifted cameras, and a world frame and scale of its own."""
    generator = np.random.default_rng(seed)
    views, height, width = exact.depth_z.shape
    coarse = torch.from_numpy(generator.normal(0, amount, (views, 1, 4, 5))).float()
    warp = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[:, 0].numpy()
    T, _ = exact.cameras()
    cameras = torch.from_numpy(T).double()
    turns = torch.from_numpy(np.concatenate((generator.normal(0, amount / 3, (views, 3)), np.ones((views, 1))), 1))
    R = quat_xyzw_to_matrix(turns / turns.norm(dim=-1, keepdim=True)) @ cameras[:, :3, :3]
    centres = camera_centres(cameras) + torch.from_numpy(generator.normal(0, amount, (views, 3)))
    moved = from_Rt(R, -(R @ centres[..., None])[..., 0])
    own = Sim3(s=torch.tensor(scale).double(), R=rotation_about_z(0.3), t=torch.tensor([1.0, 2.0, 3.0]).double())
    return replace(
        exact,
        depth_z=(exact.depth_z * np.exp(warp) * scale).astype(np.float32),
        conf=(1 + 4 * np.exp(-20 * np.abs(warp))).astype(np.float32),
        T_cam_world=own.apply_to_cameras(moved).float().numpy(),
    )


def rotation_about_z(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


def finer_photos(folder: Path, times: int = 10) -> list[MemoryPhoto]:
    """Photos of an example, so many times as fine as what the model read, which the example then says."""
    result = Reconstruction.load(folder)
    views = len(result.names)
    replace(
        result, photo_hw=np.tile(np.array(result.image_hw) * times, (views, 1)),
        scale_xy=np.full((views, 2), 1 / times), offset_xy=np.zeros((views, 2)),
    ).save(folder)  # fmt: skip
    return [
        MemoryPhoto(name, image.repeat(times, 0).repeat(times, 1))
        for name, image in zip(result.names, result.images, strict=True)
    ]


def write_example(
    folder: Path, *, views: int = 4, hw: tuple[int, int] = (48, 64), truth: bool = True, names: tuple[str, ...] = ()
) -> Path:
    """Write the folder; `names` replace the first photos' names."""
    exact = room(views, hw)
    exact = replace(exact, names=(*names, *exact.names[len(names) :]))
    disturbed(exact, 0.12, 1, scale=0.5).save(folder / "frozen")
    disturbed(exact, 0.03, 2, scale=2.0).save(folder)
    if truth:
        exact.save(folder / "truth")
    curve = [{"total": 0.02 * 0.97**k, "intra": 0.005 * 0.97**k, "cross": 0.015 * 0.97**k} for k in range(60)]
    files.write_json(
        folder / "adapter/freegeo.json", {"format": 1, "base": {"model": "example"}, "loss_curve": curve, "seed": 43}
    )
    row = {"auc05": 0.5, "auc15": 0.6, "auc30": 0.7, "abs_rel": 0.1, "f1_rel5": 0.4}
    files.write_json(folder / "scores.json", {key: {"4": row, "8": row} for key in ("frozen", "adapted")})
    files.write_json(
        folder / "reconstruction.json",
        {
            "format": 1,
            "model": "example",
            "licence_of_weights": "Apache-2.0 <weights>",
            "images": list(exact.names),
            "adapter": "adapter",
            "loss": {"first": 0.02, "last": 0.004},
            "settings": {"command": "run", "recipe": {"name": "scene", "steps": 60}},
            "seconds": {"frozen prediction": 1.5, "adaptation": 20.0},
            "versions": {"freegeo": "0.1.0"},
            "command": "freegeo run 'my photos' -o out",
        },
    )
    return folder
