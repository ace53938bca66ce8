import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from freegeo.errors import UserError
from freegeo.geometry.resample import resize_area, resize_cubic, resize_nearest

side = st.integers(1, 160)


def noise(height, width, seed):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def differences(resize, image, size, interpolation):
    """Absolute differences from OpenCV; also checks that the input survives."""
    photo = torch.from_numpy(image.copy())
    ours = resize(photo, size)
    assert ours.dtype == torch.uint8
    assert ours.shape == (*size, 3)
    assert np.array_equal(photo.numpy(), image)
    expected = cv2.resize(image, (size[1], size[0]), interpolation=interpolation)
    return np.abs(ours.numpy().astype(int) - expected.reshape(*size, 3))


@given(height=side, width=side, rows=side, columns=side, seed=st.integers(0, 1000))
@settings(max_examples=120, deadline=None)
def test_area_is_opencv_within_one_level(height, width, rows, columns, seed):
    size = (min(height, rows), min(width, columns))
    assert differences(resize_area, noise(height, width, seed), size, cv2.INTER_AREA).max() <= 1


@given(rows=st.integers(1, 30), columns=st.integers(1, 30), by=st.tuples(st.integers(1, 6), st.integers(1, 6)))
@settings(max_examples=60, deadline=None)
def test_area_of_whole_blocks_is_exactly_opencv(rows, columns, by):
    image = noise(rows * by[0], columns * by[1], rows)
    assert differences(resize_area, image, (rows, columns), cv2.INTER_AREA).max() == 0


def test_area_differs_in_very_few_values():
    sizes = [((300, 400), (63, 84)), ((427, 640), (336, 504)), ((333, 517), (126, 196)), ((480, 640), (378, 504))]
    wrong = [differences(resize_area, noise(*source, 7), target, cv2.INTER_AREA) > 0 for source, target in sizes]
    assert sum(part.sum() for part in wrong) / sum(part.size for part in wrong) <= 7e-4


@given(height=st.integers(2, 90), width=st.integers(2, 90), rows=side, columns=side, seed=st.integers(0, 1000))
@settings(max_examples=120, deadline=None)
def test_cubic_is_opencv_within_one_level(height, width, rows, columns, seed):
    # OpenCV builds without the x86 vendor library round weights to 11 bits; they too stay within one level.
    assert differences(resize_cubic, noise(height, width, seed), (rows, columns), cv2.INTER_CUBIC).max() <= 1


@pytest.mark.skipif(not cv2.ipp.useIPP() and "IPP" not in cv2.getBuildInformation(), reason="OpenCV without IPP")
def test_cubic_differs_in_very_few_values():
    sizes = [((240, 320), (378, 504)), ((60, 91), (140, 196)), ((130, 100), (98, 126)), ((50, 80), (100, 160))]
    wrong = [differences(resize_cubic, noise(*source, 7), target, cv2.INTER_CUBIC) > 0 for source, target in sizes]
    assert sum(part.sum() for part in wrong) / sum(part.size for part in wrong) <= 7e-4


@given(height=st.integers(1, 600), width=st.integers(1, 600), rows=st.integers(1, 600), columns=st.integers(1, 600))
@settings(max_examples=200, deadline=None)
def test_nearest_is_exactly_opencv(height, width, rows, columns):
    values = np.arange(height, dtype=np.float32)[:, None] + 0.001 * np.arange(width, dtype=np.float32)
    expected = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_NEAREST).reshape(rows, columns)
    assert np.array_equal(resize_nearest(torch.from_numpy(values), (rows, columns)).numpy(), expected)


@pytest.mark.parametrize("resize", [resize_area, resize_cubic])
def test_identities(resize):
    image = torch.from_numpy(noise(23, 31, 0))
    same = resize(image, (23, 31))
    assert torch.equal(same, image)
    assert same.data_ptr() != image.data_ptr()
    flat = torch.full((40, 50, 3), 77, dtype=torch.uint8)
    assert torch.equal(resize(flat, (17, 29)), flat[:17, :29])
    mirrored = resize(image.flip(1), (10, 20)).flip(1)
    assert (mirrored.int() - resize(image, (10, 20)).int()).abs().max() <= 1


def test_maps_keep_their_batch_and_type():
    masks = torch.rand(2, 3, 4, 6) > 0.5
    assert torch.equal(resize_nearest(masks, (4, 6)), masks)
    assert torch.equal(resize_nearest(masks, (8, 12))[..., ::2, ::2], masks)


def test_impossible_requests_are_refused():
    image = torch.zeros(8, 8, 3, dtype=torch.uint8)
    with pytest.raises(UserError, match="cannot enlarge"):
        resize_area(image, (9, 4))
    with pytest.raises(UserError, match="at least 1 pixel"):
        resize_cubic(image, (0, 4))
    with pytest.raises(UserError, match="8-bit"):
        resize_cubic(image.float(), (4, 4))
