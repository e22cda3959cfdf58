"""Frames of an episode: what an environment renders, enlarged, written as PNG and stored once each."""

import base64
import struct
import zlib
from typing import Any

import numpy as np

from sb3_belief.vec_env.team_vec_env import TeamVecEnv

# Least side of a frame in pixels, as far as whole factors allow it
_SIDE = 480
#: The most bytes that the frames of a page may have; more are made smaller
FRAME_BYTES = 7_000_000
# To which they are made smaller at the most
_LEAST_SIDE = 60


class NoPictureError(ValueError):
    """Error for an environment whose ``render()`` returns no picture."""


def frame_of(env: TeamVecEnv) -> np.ndarray:
    """
    Return the picture of the first copy of an environment.

    :param env: Environment with the render mode ``"rgb_array"``
    :return: uint8 ``[height, width, 3]``. Small pictures, such as those of grids with a pixel a cell, are enlarged by a whole
        number, which keeps their edges
    :raises NoPictureError: If the environment renders something else
    """
    image: Any = env.get_images()[0]
    frame = None if image is None else np.asarray(image)
    if frame is None or frame.ndim != 3 or frame.shape[2] not in (3, 4):
        found = type(image).__name__ if frame is None else f"an array of shape {frame.shape}"
        raise NoPictureError(f"the environment's render() returned {found}, not an image [height, width, 3].")
    factor = max(1, _SIDE // max(frame.shape[:2]))
    return frame[..., :3].astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)


def encode_png(image: np.ndarray) -> bytes:
    """
    Encode an image as PNG, with a palette where it has at most 256 colours.

    :param image: uint8 ``[height, width, 3]``
    :return: The file's bytes
    """
    height, width = image.shape[:2]
    wide = image.astype(np.uint32)
    packed = (wide[..., 0] << 16) | (wide[..., 1] << 8) | wide[..., 2]
    colours, indices = np.unique(packed, return_inverse=True)
    palette, rows = b"", np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    if len(colours) <= 256:
        entries = np.stack([colours >> 16, (colours >> 8) & 255, colours & 255], axis=1).astype(np.uint8)
        palette, rows = _chunk(b"PLTE", entries.tobytes()), rows[:, : 1 + width]
        rows[:, 1:] = indices.reshape(height, width)
    else:
        # Filter 2: differences to the row above, which are small in drawn pictures
        rows[:, 0] = 2
        rows[:, 1:] = image.reshape(height, -1)
        rows[1:, 1:] -= image.reshape(height, -1)[:-1]
    header = struct.pack(">IIBBBBB", width, height, 8, 3 if palette else 2, 0, 0, 0)
    data = _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + palette + data + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


class FrameStore:
    """Frames of a page. Equal ones are stored once, and all are compressed: hundreds of pictures would fill the memory."""

    def __init__(self) -> None:
        # Number by shape and compressed pixels, in order
        self._numbers: dict[tuple[tuple[int, ...], bytes], int] = {}

    def add(self, frame: np.ndarray) -> int:
        """
        Store a frame.

        :param frame: uint8 ``[height, width, 3]``
        :return: Its number
        """
        return self._numbers.setdefault((frame.shape, zlib.compress(frame.tobytes(), 1)), len(self._numbers))

    def __len__(self) -> int:
        return len(self._numbers)

    def urls(self, most_bytes: int = FRAME_BYTES) -> list[str]:
        """
        Return the frames as ``data:`` URLs.

        :param most_bytes: The most that all PNG files together may have. Frames are halved until they do, but not below 60
            pixels
        :return: One URL for each frame, by its number
        """
        largest = max((max(shape[:2]) for shape, _ in self._numbers), default=0)
        halvings, files = 0, self._files(0)
        while sum(map(len, files)) > most_bytes and largest >> (halvings + 1) >= _LEAST_SIDE:
            halvings += 1
            files = self._files(halvings)
        return ["data:image/png;base64," + base64.b64encode(file).decode() for file in files]

    def _files(self, halvings: int) -> list[bytes]:
        files = []
        for shape, pixels in self._numbers:
            frame = np.frombuffer(zlib.decompress(pixels), dtype=np.uint8).reshape(shape)
            for _ in range(halvings):
                frame = _halved(frame)
            files.append(encode_png(frame))
        return files


def _halved(frame: np.ndarray) -> np.ndarray:
    height, width = (max(2 * (side // 2), 2) for side in frame.shape[:2])
    blocks = frame[:height, :width].astype(np.uint16)
    blocks = blocks[0::2, 0::2] + blocks[1::2, 0::2] + blocks[0::2, 1::2] + blocks[1::2, 1::2]
    return (blocks // 4).astype(np.uint8)
