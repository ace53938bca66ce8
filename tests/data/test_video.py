"""Videos are small ones made here: a window that slides over a large random picture."""

from fractions import Fraction

import av
import numpy as np
import pytest

from freegeo.data import video
from freegeo.data.video import Candidate, VideoFrame, choose_by_parallax, load_video
from freegeo.errors import FreeGeoError, UserError

HEIGHT, WIDTH = 48, 64


def picture() -> np.ndarray:
    """A large smooth random picture (400, 400, 3)."""
    small = np.random.default_rng(0).integers(0, 256, (50, 50, 3), dtype=np.uint8)
    return np.kron(small, np.ones((8, 8, 1), dtype=np.uint8))


def window(x: int, y: int = 0) -> np.ndarray:
    return picture()[y : y + HEIGHT, x : x + WIDTH]


def write_video(path, images, *, times=None, rotation=None, codec="ffv1", gop=12):
    """Write images; `times` in milliseconds (default 40 ms apart)."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = {"ffv1": "bgr0", "mjpeg": "yuvj420p"}.get(codec, "yuv420p")
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.gop_size = gop
        if rotation is not None:
            stream.set_display_rotation(rotation)
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = (times[k] if times else 40 * k), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_frames_are_photos_with_the_pixels_of_the_video(tmp_path):
    images = [window(4 * k) for k in range(40)]
    frames = load_video(write_video(tmp_path / "walk.mkv", images), max_views=5)
    assert 3 <= len(frames) <= 5
    assert [f.number for f in frames] == sorted({f.number for f in frames})
    assert len({f.name for f in frames}) == len(frames)
    for frame in frames:
        assert frame.name == f"walk_{frame.number:06d}.png"
        assert frame.size_hw == (HEIGHT, WIDTH)
        assert frame.time_s == pytest.approx(0.04 * frame.number)
        assert np.abs(frame.read().astype(int) - images[frame.number]).max() <= 1


def test_read_finds_every_frame_of_a_compressed_video_again(tmp_path):
    """Frames between key frames, with B-frames: the frame that is read is the one that was chosen."""
    path = write_video(tmp_path / "v.mp4", [window(3 * k) for k in range(30)], codec="libx264")
    with av.open(str(path)) as container:
        decoded = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    frames = load_video(path, fps=25, max_views=100)
    assert len(frames) == 30
    for frame in frames[::7]:
        assert np.array_equal(frame.read(), decoded[frame.number])


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (180, 2), (-90, 3)])
def test_rotation_metadata_turns_frames_upright(tmp_path, rotation, turns):
    path = write_video(tmp_path / "phone.mp4", [window(40)] * 3, rotation=rotation, codec="libx264")
    frame = load_video(path, max_views=4)[0]
    image = frame.read()
    expected = np.rot90(window(40), turns)
    assert frame.size_hw == image.shape[:2] == expected.shape[:2]
    assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.9


def test_a_resting_camera_gives_one_view_and_motion_gives_many(tmp_path):
    noise = np.random.default_rng(1)
    rest = [np.clip(window(0) + noise.normal(0, 2, window(0).shape), 0, 255).astype(np.uint8) for _ in range(30)]
    assert len(load_video(write_video(tmp_path / "rest.mkv", rest), max_views=8)) == 1
    moving = [window(6 * k) for k in range(30)]
    frames = load_video(write_video(tmp_path / "both.mkv", rest + moving), max_views=8)
    assert len(frames) >= 6
    assert sum(f.number < 30 for f in frames) <= 2
    steps = np.diff([f.number for f in frames if f.number >= 30])
    assert steps.max() <= 2.5 * steps.mean(), "views spread evenly over the motion"


def test_the_sharper_of_neighbouring_frames_is_chosen(tmp_path):
    def blurred(image):
        return (sum(np.roll(image.astype(int), s, 1) for s in range(-6, 7)) // 13).astype(np.uint8)

    images = [window(4 * k) if k % 4 == 2 else blurred(window(4 * k)) for k in range(40)]
    path = write_video(tmp_path / "shaky.mkv", images)
    for frames in (load_video(path, max_views=8), load_video(path, fps=6.25, max_views=40)):
        assert len(frames) >= 5
        assert all(f.number % 4 == 2 for f in frames)


def test_fps_follows_timestamps_of_a_variable_frame_rate(tmp_path):
    """One second at 50 frames per second, then two seconds at 5: two frames per second are chosen in both parts."""
    times = [20 * k for k in range(50)] + [1000 + 200 * k for k in range(10)]
    images = [window(4 * k) for k in range(60)]
    frames = load_video(write_video(tmp_path / "vfr.mkv", images, times=times), fps=2, max_views=100)
    assert len(frames) == 6
    for slot, frame in enumerate(frames):
        assert 0.5 * slot <= frame.time_s < 0.5 * slot + 0.5
        assert frame.time_s == pytest.approx(times[frame.number] / 1000, abs=2e-3)
    thinned = load_video(tmp_path / "vfr.mkv", fps=2, max_views=3)
    assert [f.number for f in thinned] == [frames[0].number, frames[2].number, frames[5].number]


def test_the_number_of_candidates_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_CANDIDATES", 16)
    path = write_video(tmp_path / "long.mkv", [window(k) for k in range(120)])
    found = video.collect_candidates(path, slot_s=1 / 30)
    assert 8 <= len(found) <= 16
    assert found[-1].time_s > 4
    assert np.diff([c.time_s for c in found]).max() <= 1.2


def test_a_truncated_video_gives_what_can_be_decoded(tmp_path):
    whole = write_video(tmp_path / "whole.mkv", [window(4 * k) for k in range(40)]).read_bytes()
    path = tmp_path / "half.mkv"
    path.write_bytes(whole[: len(whole) // 2])
    frames = load_video(path, fps=25, max_views=100)
    assert 10 <= len(frames) < 30
    assert frames[-1].read().shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("content", [b"", b"not a video at all " * 50])
def test_an_unreadable_file_is_one_sentence(tmp_path, content):
    path = tmp_path / "broken.mp4"
    path.write_bytes(content)
    with pytest.raises(UserError, match="not a readable video") as error:
        load_video(path, max_views=4)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_truncated_mp4_without_its_index_is_unreadable(tmp_path):
    whole = write_video(tmp_path / "whole.mp4", [window(4 * k) for k in range(20)], codec="libx264").read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="not a readable video"):
        load_video(path, max_views=4)


def test_videos_without_frames_or_pictures_are_refused(tmp_path):
    whole = write_video(tmp_path / "some.mkv", [window(0)], codec="mjpeg").read_bytes()
    cluster = whole.index(b"\x1f\x43\xb6\x75") + 24
    empty = tmp_path / "empty.mkv"
    empty.write_bytes(whole[:cluster] + bytes(len(whole) - cluster))
    with pytest.raises(UserError, match="no frame that can be decoded"):
        load_video(empty, max_views=4)
    sound = tmp_path / "sound.mov"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(UserError, match="no video stream"):
        load_video(sound, max_views=4)


def test_options_out_of_range_are_refused(tmp_path):
    path = write_video(tmp_path / "v.mkv", [window(0)])
    with pytest.raises(UserError, match="--fps"):
        load_video(path, fps=0, max_views=4)
    with pytest.raises(UserError, match="--max-views"):
        load_video(path, max_views=0)
    with pytest.raises(UserError, match="no such video"):
        load_video(tmp_path / "absent.mp4", max_views=4)


def test_a_replaced_video_is_noticed(tmp_path):
    path = write_video(tmp_path / "v.mkv", [window(6 * k) for k in range(20)])
    last = load_video(path, max_views=4)[-1]
    write_video(path, [window(0)] * 2)
    with pytest.raises(FreeGeoError, match="no longer there"):
        last.read()


def test_parallax_never_returns_more_than_asked():
    rng = np.random.default_rng(0)
    thumbnails = rng.normal(size=(50, 36, 48)).astype(np.float16)
    candidates = [
        Candidate(number=k, pts=k, time_s=k / 25, size_hw=(4, 4), sharpness=rng.random(), thumbnail=thumbnails[k])
        for k in range(50)
    ]
    for most in (1, 2, 7, 50):
        assert 1 <= len(choose_by_parallax(candidates, most)) <= most
    assert len(choose_by_parallax(candidates, 50)) == 50


def test_names_of_videos_are_known():
    assert video.is_video("HOLIDAY.MOV")
    assert not video.is_video("photo.jpg")
    assert VideoFrame.__dataclass_params__.frozen
