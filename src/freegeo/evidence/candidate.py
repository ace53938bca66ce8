"""One prediction as the scores read it: cameras in double precision, depth where the model computed it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from freegeo.export.reconstruction import Reconstruction

__all__ = ["Candidate"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Cameras and depth of S views at the model's resolution H x W.

    Resizing keeps the corners of an image in place: what is at pixel `u` of the photo is at
    `(u + 0.5) * scale + offset - 0.5` in the model's image (docs/conventions.md, "What the formats change").
    """

    T_cam_world: Tensor
    """(S, 4, 4) float64 on the CPU."""
    K: Tensor
    """(S, 3, 3) float64 on the CPU, pixels of the model's images."""
    depth_z: Tensor
    """(S, H, W) on any device; what is not finite or not positive is unknown."""
    scale_xy: Tensor
    """(S, 2) float64 on the CPU, x first: model pixels for each photo pixel."""
    offset_xy: Tensor
    """(S, 2) float64 on the CPU."""

    @classmethod
    def of(cls, reconstruction: Reconstruction, device: torch.device | str = "cpu") -> Self:
        """Read a reconstruction; its depth goes to `device`. UserError when it has no cameras."""
        T_cam_world, K = reconstruction.cameras()
        return cls(
            T_cam_world=torch.from_numpy(T_cam_world).double(),
            K=torch.from_numpy(K).double(),
            depth_z=torch.from_numpy(reconstruction.depth_z).float().to(device),
            scale_xy=torch.from_numpy(reconstruction.scale_xy).double(),
            offset_xy=torch.from_numpy(reconstruction.offset_xy).double(),
        )

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.T_cam_world)

    def select(self, views: list[int]) -> Self:
        """Return the chosen views, in the order given."""
        index = torch.tensor(views, dtype=torch.long)
        return replace(
            self,
            T_cam_world=self.T_cam_world[index],
            K=self.K[index],
            depth_z=self.depth_z[index.to(self.depth_z.device)],
            scale_xy=self.scale_xy[index],
            offset_xy=self.offset_xy[index],
        )

    def in_model(self, view: Tensor, photo_pixel: Tensor) -> Tensor:
        """Places (n, 2) in the model's images of photo pixels (n, 2) of the views `view` (n,)."""
        return (photo_pixel + 0.5) * self.scale_xy[view] + self.offset_xy[view] - 0.5

    def matching_K(self, photo_hw: Tensor, match_hw: Tensor) -> Tensor:
        """Intrinsics (S, 3, 3) for photos of `photo_hw` (S, 2) shrunk to `match_hw` (S, 2)."""
        factor = (match_hw.double() / photo_hw.double()).flip(-1) / self.scale_xy
        rows = self.K[:, :2] * factor[:, :, None]
        rows[:, :, 2] += factor * (0.5 - self.offset_xy) - 0.5
        return torch.cat((rows, self.K[:, 2:]), dim=1)
