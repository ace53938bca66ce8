"""Camera-to-world poses with OpenCV axes in text: TUM and KITTI trajectories, and one 4x4 matrix in a file each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from freegeo import files
from freegeo.cameras.base import CameraFile, FileCamera, Format, read_text
from freegeo.cameras.convention import matrix_of
from freegeo.cameras.known import KnownCameras
from freegeo.data.photos import natural_key
from freegeo.errors import UserError
from freegeo.export.tum import times_of_names
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix

READING = "c2w-opencv"
_ENDINGS = (".pose.txt", "_pose.txt", ".txt")
_SUB_FOLDERS = ("", "pose", "poses")


def _rows(path: Path) -> list[list[float]]:
    """Rows of numbers, between spaces or commas, without comments; ValueError for anything else."""
    lines = (line.partition("#")[0].replace(",", " ").split() for line in read_text(path).splitlines())
    return [[float(token) for token in line] for line in lines if line]


def _columns(path: Path) -> set[int]:
    """Return how many numbers the rows of a text file have; none for what is no table of numbers."""
    if not path.is_file() or path.stat().st_size > 100_000_000:
        return set()
    try:
        return {len(row) for row in _rows(path)}
    except (ValueError, UserError):
        return set()


def _read_rows(path: Path, columns: tuple[int, ...], what: str) -> list[list[float]]:
    try:
        rows = _rows(path)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path}: not a table of numbers ({error}).") from None
    wrong = next((number for number, row in enumerate(rows, 1) if len(row) not in columns), None)
    if wrong is not None:
        raise UserError(f"{path}: row {wrong} has {len(rows[wrong - 1])} numbers, and {what}.")
    return rows


def find_tum(path: Path) -> Path | None:
    """Return a file whose rows all have eight numbers."""
    return path if _columns(path) == {8} else None


def read_tum(path: Path) -> CameraFile:
    """Read rows of time stamp, translation and quaternion (x, y, z, w)."""
    cameras = []
    for row in _read_rows(path, (8,), "a TUM trajectory has 8: time, tx, ty, tz, qx, qy, qz, qw"):
        quat = torch.tensor(row[4:], dtype=torch.float64)
        if not 0.9 < float(quat.norm()) < 1.1:
            raise UserError(f"{path}: the quaternion at the time {row[0]:g} does not have the length 1.")
        matrix = np.eye(4)
        matrix[:3, :3] = quat_xyzw_to_matrix(quat).numpy()
        matrix[:3, 3] = row[1:4]
        cameras.append(FileCamera(name=repr(row[0]), matrix=matrix))
    return CameraFile(source=str(path), cameras=cameras, by="time")


def write_tum(known: KnownCameras, path: Path) -> None:
    """Write poses; times are the photos' names where all are different numbers, else 0, 1, 2, ..."""
    matrices = _matrices(known, "a TUM trajectory")
    lines = []
    for time, matrix in zip(times_of_names(known.names), matrices, strict=True):
        quat = matrix_to_quat_xyzw(torch.from_numpy(matrix[:3, :3].copy())).tolist()
        lines.append(" ".join(repr(float(value)) for value in [time, *matrix[:3, 3], *quat]) + "\n")
    with files.atomic_path(path) as part:
        part.write_text("# time tx ty tz qx qy qz qw (camera to world)\n" + "".join(lines), encoding="utf-8")


def find_kitti(path: Path) -> Path | None:
    """Return a file whose rows all have twelve numbers, or all sixteen."""
    return path if _columns(path) in ({12}, {16}) else None


def read_kitti(path: Path) -> CameraFile:
    """Read rows of a 3x4 matrix, or of a 4x4 one, row by row."""
    cameras = []
    for number, row in enumerate(_read_rows(path, (12, 16), "a KITTI trajectory has 12")):
        matrix = np.eye(4)
        matrix[: len(row) // 4] = np.reshape(row, (-1, 4))
        cameras.append(FileCamera(name=f"{number:06d}", matrix=matrix))
    return CameraFile(source=str(path), cameras=cameras, by="order")


def write_kitti(known: KnownCameras, path: Path) -> None:
    """Write poses in the order of the photos."""
    rows = [" ".join(repr(float(value)) for value in matrix[:3].ravel()) for matrix in _matrices(known, "KITTI poses")]
    with files.atomic_path(path) as part:
        part.write_text("".join(f"{row}\n" for row in rows), encoding="utf-8")


def _matrices(known: KnownCameras, what: str) -> np.ndarray:
    poses = [one.T_cam_world for one in known.cameras]
    missing = next((name for name, pose in zip(known.names, poses, strict=True) if pose is None), None)
    if missing is not None:
        raise UserError(f"{missing}: has no pose, and {what} need one of every photo. Write cameras.json instead.")
    return np.stack([matrix_of(pose, READING) for pose in poses if pose is not None])


def find_poses(path: Path) -> Path | None:
    """Return the folder that holds a 4x4 matrix in a file each."""
    if path.is_file():
        return path.parent if _columns(path) == {4} and len(_rows(path)) == 4 else None
    return next((path / place for place in _SUB_FOLDERS if _pose_files(path / place)), None)


def _pose_files(folder: Path) -> list[Path]:
    """Return the files of a folder that look like poses: `*.pose.txt`, or else all texts of four rows of four."""
    if not folder.is_dir():
        return []
    texts = sorted(folder.glob("*.txt"), key=natural_key)
    named = [text for text in texts if text.name.endswith(_ENDINGS[:2])]
    return named or [text for text in texts if _columns(text) == {4} and len(_rows(text)) == 4]


def read_poses(folder: Path) -> CameraFile:
    """Read one 4x4 matrix from each file, which is named after its photo."""
    cameras = []
    for file in _pose_files(folder):
        rows = _read_rows(file, (4,), "a pose has 4 rows of 4")
        if len(rows) != 4:
            raise UserError(f"{file}: has {len(rows)} rows, and a pose has 4 rows of 4 numbers.")
        name = next(file.name.removesuffix(ending) for ending in _ENDINGS if file.name.endswith(ending))
        cameras.append(FileCamera(name=name, matrix=np.array(rows)))
    return CameraFile(source=str(folder), cameras=cameras)


TUM = Format(
    name="tum", about="TUM trajectory: time, translation, quaternion", reading=READING, find=find_tum, read=read_tum,
    write=write_tum,
)  # fmt: skip
KITTI = Format(
    name="kitti", about="KITTI trajectory: a 3x4 matrix a row, in the order of the photos", reading=READING,
    find=find_kitti, read=read_kitti, write=write_kitti,
)  # fmt: skip
POSES = Format(
    name="poses", about="folder of 4x4 matrices, such as frame-000000.pose.txt of 7-Scenes", reading=READING,
    find=find_poses, read=read_poses,
)  # fmt: skip
