"""Videos are small ones made here: a window that slides over a large random picture."""

from contextlib import contextmanager
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from freegeo.data import video
from freegeo.data.video import Candidate, VideoFrame, choose_by_parallax, collect_candidates, load_video
from freegeo.errors import FreeGeoError, UserError

HEIGHT, WIDTH = 48, 64


def picture() -> np.ndarray:
    """A large smooth random picture (400, 400, 3)."""
    small = np.random.default_rng(0).integers(0, 256, (50, 50, 3), dtype=np.uint8)
    return np.kron(small, np.ones((8, 8, 1), dtype=np.uint8))


def window(x: int, y: int = 0) -> np.ndarray:
    return picture()[y : y + HEIGHT, x : x + WIDTH]


def write_video(
    path, images, *, times=None, rotation=None, mirrored=False, pixel_aspect=None, codec="ffv1", gop=12, options=None
):
    """Write images; `times` in milliseconds (default 40 ms apart)."""
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = {"ffv1": "bgr0", "mjpeg": "yuvj420p"}.get(codec, "yuv420p")
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.gop_size = gop
        if rotation is not None:
            stream.set_display_rotation(rotation, hflip=mirrored)
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
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


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (180, 2)])
def test_mirrored_videos_are_shown_as_players_do(tmp_path, rotation, turns):
    images = [window(40)] * 3
    path = write_video(tmp_path / "selfie.mp4", images, rotation=rotation, mirrored=True, codec="libx264")
    frame = load_video(path, max_views=4)[0]
    expected = np.rot90(window(40), turns)[:, ::-1]
    assert frame.size_hw == expected.shape[:2]
    assert np.corrcoef(frame.read().ravel(), expected.ravel())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("aspect", "rotation", "size_hw"),
    [
        ((4, 3), None, (HEIGHT, 85)),
        ((8, 9), None, (54, WIDTH)),
        ((4, 3), 90, (85, HEIGHT)),
        ((1, 1), None, (HEIGHT, WIDTH)),
    ],
)
@pytest.mark.parametrize("name", ["hdv.mp4", "hdv.mkv"])
def test_pixels_are_made_square(tmp_path, aspect, rotation, size_hw, name):
    path = write_video(
        tmp_path / name, [window(40)] * 3, rotation=rotation, pixel_aspect=Fraction(*aspect), codec="libx264"
    )
    frame = load_video(path, max_views=4)[0]
    stored = np.rot90(window(40), 1 if rotation else 0)
    expected = np.asarray(Image.fromarray(np.ascontiguousarray(stored)).resize(size_hw[::-1], Image.Resampling.BICUBIC))
    assert frame.size_hw == frame.read().shape[:2] == size_hw
    assert np.corrcoef(frame.read().ravel(), expected.ravel())[0, 1] > 0.9


def test_pixels_that_no_camera_has_are_refused(tmp_path):
    path = write_video(tmp_path / "v.mp4", [window(0)] * 2, pixel_aspect=Fraction(20, 1), codec="libx264")
    with pytest.raises(UserError, match="20 times as wide as high"):
        load_video(path, max_views=4)


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


@pytest.mark.parametrize("codec", ["libx264", "mjpeg"])
def test_a_damaged_packet_is_skipped_and_counted(tmp_path, caplog, codec):
    rng = np.random.default_rng(0)
    path = write_video(tmp_path / "v.mp4", [rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)] * 40, codec=codec)
    assert len(load_video(path, fps=25, max_views=99)) == 40
    assert not caplog.text
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    spoilt = bytearray(path.read_bytes())
    for packet in packets[18:20]:
        spoilt[packet.pos : packet.pos + packet.size] = bytes(packet.size)
    path.write_bytes(spoilt)
    frames = load_video(path, fps=25, max_views=99)
    assert len(frames) == 38
    assert frames[-1].time_s == pytest.approx(39 * 0.04)
    assert frames[-1].read().shape == (HEIGHT, WIDTH, 3)
    assert "2 damaged frames are left out" in caplog.text
    assert len(caplog.records) == 1, "reading says nothing again"


def test_a_video_that_ends_early_is_said(tmp_path, caplog):
    whole = write_video(tmp_path / "v.mkv", [window(4 * k) for k in range(60)]).read_bytes()
    load_video(tmp_path / "v.mkv", fps=25, max_views=99)
    assert not caplog.text
    (tmp_path / "v.mkv").write_bytes(whole[: len(whole) // 2])
    assert len(load_video(tmp_path / "v.mkv", fps=25, max_views=99)) < 40
    assert "should be 2.4 s long, but its frames end at" in caplog.text


def test_black_frames_are_no_views(tmp_path, caplog):
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    path = write_video(tmp_path / "fade.mkv", [black] * 5 + [window(6 * k) for k in range(20)] + [black] * 5)
    assert all(5 <= frame.number < 25 for frame in load_video(path, max_views=8))
    assert all(5 <= frame.number < 25 for frame in load_video(path, fps=25, max_views=99))
    assert not caplog.text
    assert len(load_video(write_video(tmp_path / "dark.mkv", [black] * 5), max_views=8)) == 1
    assert "almost black, white or of one colour in every frame" in caplog.text


@pytest.mark.parametrize(
    "content",
    [
        "ffconcat version 1.0\nfile secret.mkv\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.mkv\n#EXT-X-ENDLIST\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
        "<?xml version='1.0'?><MPD xmlns='urn:mpeg:dash:schema:mpd:2011' profiles='x'></MPD>",
    ],
    ids=["ffconcat", "m3u8", "sdp", "dash"],
)
def test_playlists_do_not_open_other_files(tmp_path, content):
    write_video(tmp_path / "secret.mkv", [window(4 * k) for k in range(5)])
    (tmp_path / "list.mp4").write_text(content)
    with pytest.raises(UserError, match=r"list\.mp4: not a readable video"):
        load_video(tmp_path / "list.mp4", max_views=4)


def test_names_are_names_and_no_addresses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "v.mkv", [window(4 * k) for k in range(5)])
    for name in ("http:v.mkv", "concat:v.mkv|v.mkv", "v%03d.mkv", "v 1?.mkv"):
        (tmp_path / "v.mkv").rename(name)
        assert load_video(name, max_views=4)[0].read().shape == (HEIGHT, WIDTH, 3)
        (tmp_path / name).rename("v.mkv")


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
    assert video.is_video("clip.ts")
    assert video.is_video("clip.wmv")
    assert not video.is_video("photo.jpg")
    assert not video.is_video("photo.gif")
    assert VideoFrame.__dataclass_params__.frozen


def test_a_video_above_the_pixel_limit_is_refused_by_its_header(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mkv", [window(4 * k) for k in range(4)])
    monkeypatch.setattr(video, "MAX_PIXELS", WIDTH * HEIGHT)
    assert load_video(path, max_views=1)
    monkeypatch.setattr(video, "MAX_PIXELS", WIDTH * HEIGHT - 1)
    with pytest.raises(UserError, match=r"a\.mkv: frames of 64 x 48 pixels are more than the limit"):
        load_video(path, max_views=1)


def test_frames_that_are_larger_than_the_header_says_are_not_decoded(tmp_path, monkeypatch, caplog):
    """They come later than FFmpeg looks when it opens a file."""
    for name, image, start, count in (("small", window(0), 0, 40), ("large", picture()[:320, :320], 20_000, 4)):
        times = [start + 400 * k for k in range(count)]
        write_video(tmp_path / f"{name}.ts", [image] * count, times=times, codec="libx264", gop=1)
    both = tmp_path / "both.ts"
    both.write_bytes((tmp_path / "small.ts").read_bytes() + (tmp_path / "large.ts").read_bytes())
    sizes = {candidate.size_hw for candidate in collect_candidates(both, slot_s=0.01)}
    assert sizes == {(HEIGHT, WIDTH), (320, 320)}
    monkeypatch.setattr(video, "MAX_PIXELS", WIDTH * HEIGHT)
    assert {candidate.size_hw for candidate in collect_candidates(both, slot_s=0.01)} == {(HEIGHT, WIDTH)}
    assert "damaged frames are left out" in caplog.text


class Unseekable:
    """A container in which nothing can be sought."""

    def __init__(self, container, error):
        self.container, self.error = container, error

    def __getattr__(self, name):
        return getattr(self.container, name)

    def seek(self, *arguments, **options):
        raise self.error


@pytest.mark.parametrize(
    "error", [OSError(1, "not permitted"), av.error.ArgumentError(22, "invalid"), ValueError("x")], ids=repr
)
def test_a_file_that_cannot_be_sought_in_is_decoded_from_its_start(tmp_path, monkeypatch, error):
    frames = load_video(write_video(tmp_path / "a.mkv", [window(4 * k) for k in range(20)]), max_views=3)
    expected, opened = [frame.read() for frame in frames], video._opened

    @contextmanager
    def unseekable(path):
        with opened(path) as container:
            yield Unseekable(container, error)

    monkeypatch.setattr(video, "_opened", unseekable)
    assert all(np.array_equal(frame.read(), pixels) for frame, pixels in zip(frames, expected, strict=True))
