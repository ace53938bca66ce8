"""Camera files whose numbers no camera can have, or that announce more than they hold: one sentence each."""

import json
import struct

import pytest

from freegeo.cameras.reading import read_camera_file
from freegeo.errors import UserError

EYE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FRAME = {"file_path": "a.png", "w": 16, "h": 12, "fl_x": 10.0, "transform_matrix": EYE}


@pytest.mark.parametrize("place", ["w", "fl_x", "transform_matrix"])
@pytest.mark.parametrize("number", ["9" * 400, "9" * 5_000, "1e999", "NaN"], ids=["400", "5000", "1e999", "nan"])
def test_numbers_that_no_camera_has(tmp_path, place, number):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [FRAME]}).replace(f'"{place}": ', f'"{place}": {number}, "x": '))
    with pytest.raises(UserError) as refused:
        read_camera_file(path)
    assert len(str(refused.value)) < 1_000 and "\n" not in str(refused.value)


def test_json_that_is_nested_too_deeply(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text("[" * 100_000)
    with pytest.raises(UserError, match="broken JSON"):
        read_camera_file(path)


def model(folder, cameras=1, images=1, points=0):
    """A binary model of one camera and one image, with the given counts in the place of the true ones."""
    folder.mkdir()
    camera = struct.pack("<iiQQ4d", 1, 1, 16, 12, 10, 10, 8, 6)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", cameras) + camera)
    image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q", points)
    (folder / "images.bin").write_bytes(struct.pack("<Q", images) + image)
    return folder


@pytest.mark.parametrize("count", [2, 1 << 40, (1 << 64) - 1], ids=str)
@pytest.mark.parametrize("what", ["cameras", "images", "points"])
def test_colmap_models_that_announce_more_than_they_hold(tmp_path, what, count):
    assert read_camera_file(model(tmp_path / "sound")).names == ("a.png",)
    with pytest.raises(UserError, match=rf"ends before the {count} entries that it announces"):
        read_camera_file(model(tmp_path / "damaged", **{what: count}))


def test_a_colmap_model_with_a_side_that_no_image_has(tmp_path):
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {'9' * 400} 12 10 10 8 6\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    with pytest.raises(UserError, match="a side that is not between 1 and 1,000,000 pixels"):
        read_camera_file(tmp_path)
