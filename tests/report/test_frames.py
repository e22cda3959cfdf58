import base64
import io

import numpy as np
import pytest

from sb3_belief.report.frames import FrameStore, NoPictureError, encode_png, frame_of

image = pytest.importorskip("imageio.v3", reason="reads the pictures back: pip install 'sb3-belief[plots]'")


def drawn(n_colours, shape=(30, 40)):
    """A picture with so many different colours."""
    rng = np.random.default_rng(n_colours)
    colours = np.stack([np.arange(n_colours) % 251, np.arange(n_colours) // 251, np.full(n_colours, 7)], axis=1)
    order = rng.permutation(np.arange(shape[0] * shape[1]) % n_colours)
    return colours[order.reshape(shape)].astype(np.uint8)


@pytest.mark.parametrize("n_colours", [1, 2, 256, 257, 1000])
def test_png_holds_the_very_pixels(n_colours):
    picture = drawn(n_colours)
    np.testing.assert_array_equal(image.imread(io.BytesIO(encode_png(picture)), extension=".png"), picture)


def test_equal_frames_are_stored_once():
    store, first, second = FrameStore(), drawn(3), drawn(4)
    assert [store.add(frame) for frame in (first, second, first.copy(), second)] == [0, 1, 0, 1]
    assert len(store) == len(store.urls()) == 2
    # Bytes alone do not tell shapes apart
    assert store.add(first.reshape(40, 30, 3)) == 2


def test_frames_that_are_too_large_together_are_halved():
    store = FrameStore()
    for seed in range(3):
        store.add(np.random.default_rng(seed).integers(0, 256, (500, 480, 3), dtype=np.uint8))

    def files():
        return [base64.b64decode(url.partition(",")[2]) for url in store.urls(most_bytes=700_000)]

    sizes = [image.imread(io.BytesIO(file), extension=".png").shape for file in files()]
    assert sizes == [(250, 240, 3)] * 3 and sum(map(len, files())) < 700_000
    flat = FrameStore()
    # Rows that alternate, so that each pixel becomes the mean of four
    flat.add(np.tile(np.array([[[10, 20, 30]], [[30, 40, 50]]], np.uint8), (150, 300, 1)))
    (url,) = flat.urls(most_bytes=1)
    # Not below 60 pixels
    halved = image.imread(io.BytesIO(base64.b64decode(url.partition(",")[2])), extension=".png")
    assert halved.shape == (75, 75, 3) and (halved == [20, 30, 40]).all()


class Rendering:
    def __init__(self, result):
        self.result = result

    def get_images(self):
        return [self.result]


def test_what_is_rendered_becomes_a_frame_with_whole_factors():
    frame = frame_of(Rendering(np.arange(24, dtype=np.uint8).reshape(2, 3, 4)))  # type: ignore[arg-type]
    assert frame.shape == (320, 480, 3) and frame[0, 0].tolist() == [0, 1, 2] and frame[-1, -1].tolist() == [20, 21, 22]
    large = np.zeros((700, 300, 3), np.uint8)
    assert frame_of(Rendering(large)).shape == (700, 300, 3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("result", "message"), [(None, "NoneType"), ("text", r"shape \(\)"), (np.zeros((4, 6)), r"shape \(4, 6\)")]
)
def test_what_is_no_picture_is_refused(result, message):
    with pytest.raises(NoPictureError, match=message):
        frame_of(Rendering(result))  # type: ignore[arg-type]
