"""Fusing depth maps into a truncated signed distance volume made of sparse blocks, one frame at a time.

The computation is that of the published evaluation (docs/benchmark.md, "Fusion and scoring"): float32 values, classic
projective distance measured along the ray, no maximum weight. Memory grows with the seen surface: 32 KiB per block of
16^3 voxels.
"""

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.fusion.marching import extract_surface
from freegeo.fusion.mesh import Mesh

BLOCK = 16
"""Voxels along the edge of a block."""
_VOXELS = BLOCK**3
_PIXEL_STEP = 4
_BORDER = 1e-4
_KEY_BITS = 21
_KEY_HALF = 1 << (_KEY_BITS - 1)
_CPU_CHUNK_BLOCKS = 16  # 256 KiB per intermediate, so that they stay in a core's cache
_CUDA_CHUNK_BLOCKS = 2048


class TsdfVolume:
    """A growing set of voxel blocks that stores the surface seen so far.

    ```python
    volume = TsdfVolume(voxel=0.02, truncation=0.08)
    for depth_z, K, T_cam_world in frames:
        volume.integrate(depth_z, K, T_cam_world)
    mesh = volume.extract_mesh()
    ```
    """

    def __init__(self, *, voxel: float, truncation: float, device: torch.device | str = "cpu"):
        """Start empty.

        Args:
            voxel: voxel edge in metres.
            truncation: distance in metres at which the signed distance is cut.
            device: of the volume and of the integration; for Apple's GPUs, which have no float64, the CPU is taken.
        """
        if not (voxel > 0 and truncation > 0):
            raise UserError(f"Voxel edge and truncation must be positive, not {voxel} and {truncation}.")
        self.voxel = float(voxel)
        self.truncation = float(truncation)
        self.device = torch.device("cpu" if torch.device(device).type == "mps" else device)
        self.block_edge = BLOCK * self.voxel
        self._keys = torch.empty(0, dtype=torch.int64, device=self.device)  # sorted
        self._rows = torch.empty(0, dtype=torch.int64, device=self.device)  # storage row of each key
        self._tsdf = torch.empty(0, _VOXELS, device=self.device)
        self._weight = torch.empty(0, _VOXELS, device=self.device)

    @property
    def block_count(self) -> int:
        """Number of allocated blocks."""
        return len(self._keys)

    def blocks(self) -> tuple[Tensor, Tensor, Tensor]:
        """Block indices (n, 3) int64, signed distances / truncation and weights, each (n, 16, 16, 16), axes x, y, z."""
        shape = (len(self._rows), BLOCK, BLOCK, BLOCK)
        return _unpack(self._keys), self._tsdf[self._rows].view(shape), self._weight[self._rows].view(shape)

    def integrate(self, depth_z: Tensor, K: Tensor, T_cam_world: Tensor, *, depth_limit: float = float("inf")) -> None:
        """Add one depth map.

        Only blocks near this frame's own surface are updated; free space elsewhere is not carved. Surface farther than
        2^20 blocks from the world origin is left out.

        Args:
            depth_z: (H, W) metres; values that are not finite, not positive, or from `depth_limit` on are ignored.
            K: (3, 3) pixels, centres at whole coordinates.
            T_cam_world: (4, 4) world-to-camera.
            depth_limit: metres.

        Raises:
            UserError: wrong shapes, or a camera that is not finite.
        """
        depth, K, T = self._checked_frame(depth_z, K, T_cam_world)
        depth = torch.where(depth.isfinite() & (depth > 0) & (depth < depth_limit), depth, 0.0)
        keys = self._touched(depth, K, T)
        if len(keys) == 0:
            return
        rows = self._rows_of(keys)
        corners = (_unpack(keys).double() * self.block_edge) @ T[:3, :3].mT + T[
            :3, 3
        ]  # of the blocks, in the camera's frame
        chunk = _CPU_CHUNK_BLOCKS if self.device.type == "cpu" else _CUDA_CHUNK_BLOCKS
        frame = _Frame(depth, K, T, self.voxel, self.truncation)
        for start in range(0, len(rows), chunk):
            some = rows[start : start + chunk]
            tsdf, weight = frame.update(corners[start : start + chunk], self._tsdf[some], self._weight[some])
            self._tsdf[some] = tsdf
            self._weight[some] = weight

    def extract_mesh(self) -> Mesh:
        """The zero surface, from cubes whose eight corners were all seen; empty when there is none."""
        vertices, triangles = extract_surface(*self.blocks(), voxel=self.voxel)
        return Mesh(vertices=vertices.cpu().numpy(), triangles=triangles.cpu().numpy())

    def _checked_frame(self, depth_z: Tensor, K: Tensor, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shapes = tuple(depth_z.shape), tuple(K.shape), tuple(T.shape)
        if depth_z.ndim != 2 or shapes[1:] != ((3, 3), (4, 4)):
            raise UserError(f"Fusion takes depth (H, W), K (3, 3) and T_cam_world (4, 4), not {shapes}.")
        K, T = K.to(self.device, torch.float64), T.to(self.device, torch.float64)
        if not (K.isfinite().all() and T.isfinite().all()):
            raise UserError("A camera with values that are not finite cannot be fused; drop that frame.")
        return depth_z.to(self.device, torch.float32), K, T

    def _touched(self, depth: Tensor, K: Tensor, T: Tensor) -> Tensor:
        """Sorted keys of all blocks within the truncation (as a cube) of every 4th pixel's point."""
        sparse = depth[::_PIXEL_STEP, ::_PIXEL_STEP].double()
        v, u = (_PIXEL_STEP * index for index in torch.nonzero(sparse > 0, as_tuple=True))
        z = sparse[sparse > 0]
        in_camera = torch.stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z], dim=-1)
        points = (in_camera - T[:3, 3]) @ T[:3, :3]
        low = torch.floor((points - self.truncation) / self.block_edge)
        high = torch.floor((points + self.truncation) / self.block_edge)
        near = ((low > -_KEY_HALF) & (high < _KEY_HALF)).all(dim=-1)
        low, high = low[near].long(), high[near].long()
        span = range(int(2 * self.truncation / self.block_edge) + 2)
        keys = []
        for offset in torch.cartesian_prod(*[torch.tensor(span, device=self.device)] * 3):
            cells = low + offset
            # Neighbouring pixels mostly touch the same block: drop repeats before the sort.
            keys.append(torch.unique_consecutive(_pack(cells[(cells <= high).all(dim=-1)])))
        return torch.unique(torch.cat(keys))

    def _rows_of(self, keys: Tensor) -> Tensor:
        """Storage row of each key (n,), with new blocks for new keys."""
        known = _contains(self._keys, keys)
        new = keys[~known]
        if len(new):
            first = len(self._keys)
            self._reserve(first + len(new))
            rows = torch.arange(first, first + len(new), device=self.device)
            self._keys, order = torch.cat([self._keys, new]).sort()
            self._rows = torch.cat([self._rows, rows])[order]
        return self._rows[torch.searchsorted(self._keys, keys)]

    def _reserve(self, blocks: int) -> None:
        capacity = len(self._tsdf)
        if blocks > capacity:
            grown = max(blocks, capacity + capacity // 2) - capacity
            empty = torch.zeros(grown, _VOXELS, device=self.device)
            self._tsdf = torch.cat([self._tsdf, empty])
            self._weight = torch.cat([self._weight, empty])


class _Frame:
    """One depth map with the tables that all of its blocks share."""

    def __init__(self, depth: Tensor, K: Tensor, T: Tensor, voxel: float, truncation: float):
        self.height, self.width = depth.shape
        self.truncation = truncation
        self.K = K
        centres = (torch.arange(BLOCK, device=depth.device, dtype=torch.float64) + 0.5) * voxel
        grid = torch.cartesian_prod(centres, centres, centres)
        self.offset_xyz = self._scaled(grid @ T[:3, :3].mT).float()
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        self.shift_u, self.shift_v = float(cx + 0.5), float(cy + 0.5)
        u = (torch.arange(self.width, device=depth.device) - cx) / fx
        v = (torch.arange(self.height, device=depth.device) - cy) / fy
        # A depth of -inf puts the distances of a pixel without depth below any truncation, so it changes no voxel.
        self.depth = torch.where(depth > 0, depth, float("-inf")).flatten()
        self.ray_length = (1 + u**2 + v[:, None] ** 2).sqrt().float().flatten()

    def _scaled(self, xyz: Tensor) -> Tensor:
        """Camera coordinates with x and y already multiplied by the focal lengths, (3, n, 1) or (3, 1, n)."""
        return torch.stack([xyz[:, 0] * self.K[0, 0], xyz[:, 1] * self.K[1, 1], xyz[:, 2]])

    def update(self, corners: Tensor, tsdf: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """New (n, 4096) values of n blocks whose corners lie at (n, 3) in this camera's frame."""
        x, y, z = (self._scaled(corners).float()[:, :, None] + self.offset_xyz[:, None, :]).unbind(0)
        u = (x / z).add_(self.shift_u)
        v = (y / z).add_(self.shift_v)
        inside = (z > 0) & (u >= _BORDER) & (u < self.width - _BORDER) & (v >= _BORDER) & (v < self.height - _BORDER)
        column = u.clamp_(0, self.width - 1).int()
        pixel = v.clamp_(0, self.height - 1).int().mul_(self.width).add_(column).flatten()
        distance = self.depth.index_select(0, pixel).view_as(z).sub_(z)
        distance.mul_(self.ray_length.index_select(0, pixel).view_as(z))
        inside &= distance > -self.truncation
        fused = distance.div_(self.truncation).clamp_max_(1).addcmul_(tsdf, weight).div_(weight + 1)
        return torch.where(inside, fused, tsdf), weight + inside


def _pack(blocks: Tensor) -> Tensor:
    """Block indices (n, 3) as sortable int64 keys (n,)."""
    a, b, c = (blocks + _KEY_HALF).unbind(-1)
    return (a << (2 * _KEY_BITS)) | (b << _KEY_BITS) | c


def _unpack(keys: Tensor) -> Tensor:
    mask = (1 << _KEY_BITS) - 1
    return torch.stack([keys >> (2 * _KEY_BITS), (keys >> _KEY_BITS) & mask, keys & mask], dim=-1) - _KEY_HALF


def _contains(sorted_keys: Tensor, keys: Tensor) -> Tensor:
    if len(sorted_keys) == 0:
        return torch.zeros_like(keys, dtype=torch.bool)
    place = torch.searchsorted(sorted_keys, keys).clamp_max(len(sorted_keys) - 1)
    return sorted_keys[place] == keys
