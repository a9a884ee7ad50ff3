"""A camera that films people walking past a photograph: JPEG frames, and where the people really are in them.

The photograph is the portrait that ships with matplotlib (Grace Hopper, public domain); the people are drawn, because a
HOG detector wants to see whole bodies. Frames are encoded once and shown in a loop, as a film would be.
"""

from __future__ import annotations

import importlib.util
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Image = Any

WIDTH, HEIGHT = 1280, 820
# Gives 100 to 150 kB a frame, as a street scene of this size has.
JPEG_QUALITY = 88
SENSOR_NOISE = 4.0
FLOOR_TOP = 520
WALL_GREY, FLOOR_GREY = 172, 118
# Drawing coordinates have 4 fractional bits, so that nobody moves in whole pixels.
SUBPIXEL_BITS = 4


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in pixels; the origin is the image's top left corner."""

    x: float
    y: float
    width: float
    height: float

    def overlap(self, other: Box) -> float:
        """Intersection over union, 0 to 1."""
        across = min(self.x + self.width, other.x + other.width) - max(self.x, other.x)
        down = min(self.y + self.height, other.y + other.height) - max(self.y, other.y)
        if across <= 0 or down <= 0:
            return 0.0
        return across * down / (self.width * self.height + other.width * other.height - across * down)


@dataclass(frozen=True, slots=True)
class Frame:
    """One encoded frame and the people in it."""

    jpeg: bytes
    people: tuple[Box, ...]


@dataclass(frozen=True, slots=True)
class Walker:
    """A person who walks to and fro: at `centre` pixels on average, `reach` to either side, all in pixels."""

    centre: float
    reach: float
    phase: float
    feet: float
    height: float
    coat: tuple[int, int, int]


WALKERS = (
    Walker(centre=210, reach=110, phase=0.0, feet=690, height=330, coat=(70, 55, 45)),
    Walker(centre=660, reach=150, phase=2.1, feet=735, height=400, coat=(45, 40, 80)),
    Walker(centre=1080, reach=90, phase=4.2, feet=700, height=340, coat=(60, 75, 50)),
)


def film(frames: int, seed: int, photograph: Path | None = None) -> list[Frame]:
    """A loop of `frames` frames. Raises ValueError if the photograph can't be read."""
    rng = np.random.default_rng(seed)
    scene = _scene(photograph or default_photograph())
    return [_frame(scene, number / frames, rng) for number in range(frames)]


def default_photograph() -> Path:
    """The portrait among matplotlib's sample data. Raises ValueError if matplotlib is not installed."""
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        raise ValueError("matplotlib is not installed, whose sample photograph is the default; name another one")
    return Path(spec.origin).parent / "mpl-data" / "sample_data" / "grace_hopper.jpg"


def _scene(photograph: Path) -> Image:
    portrait = cv2.imread(str(photograph))
    if portrait is None:
        raise ValueError(f"{photograph}: not a readable image")
    scene = np.full((HEIGHT, WIDTH, 3), WALL_GREY, np.uint8)
    scene[FLOOR_TOP:] = FLOOR_GREY
    height = FLOOR_TOP - 60
    width = min(WIDTH // 2, portrait.shape[1] * height // portrait.shape[0])
    left = (WIDTH - width) // 2
    scene[30 : 30 + height, left : left + width] = cv2.resize(portrait, (width, height), interpolation=cv2.INTER_AREA)
    return scene


def _frame(scene: Image, turn: float, rng: np.random.Generator) -> Frame:
    """The frame at `turn` (0 to 1) of the loop."""
    image = scene.copy()
    people = tuple(_draw(image, walker, turn) for walker in WALKERS)
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    noise: NDArray[np.float32] = rng.standard_normal(image.shape, np.float32) * SENSOR_NOISE
    image = np.clip(image + noise, 0, 255).astype(np.uint8)
    encoded, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise RuntimeError("OpenCV could not encode a frame")
    return Frame(jpeg.tobytes(), people)


def _draw(image: Image, walker: Walker, turn: float) -> Box:
    """Draw one person and return the box around the body."""
    angle = 2 * np.pi * turn + walker.phase
    middle = walker.centre + walker.reach * float(np.sin(angle))
    # Three steps each way; the legs are a tenth of the body's height apart at most.
    stride = 8.0 * abs(float(np.sin(3 * angle)))
    unit = walker.height / 100
    scale = 1 << SUBPIXEL_BITS
    skin, trousers, hair, shoes = (140, 160, 205), (45, 38, 32), (30, 30, 34), (20, 20, 20)

    def at(x: float, y: float) -> tuple[int, int]:
        # Body coordinates: percent of the height, x from the middle, y up from the floor.
        return round((middle + x * unit) * scale), round((walker.feet - y * unit) * scale)

    def limb(*joints: tuple[float, float], thick: float, colour: tuple[int, int, int]) -> None:
        for here, there in itertools.pairwise(joints):
            cv2.line(image, at(*here), at(*there), colour, round(thick * unit), cv2.LINE_AA, SUBPIXEL_BITS)

    for side in (-1, 1):
        foot = side * (4 + stride)
        limb((side * 4, 47), (side * (4 + 0.6 * stride), 24), (foot, 3), thick=8, colour=trousers)
        limb((foot, 2), (foot + 3, 2), thick=5, colour=shoes)
        limb((side * 12, 78), (side * 14, 60), (side * 13, 46), thick=5.5, colour=walker.coat)
    torso = ((-12, 80), (-6, 85), (6, 85), (12, 80), (10, 60), (11, 44), (-11, 44), (-10, 60))
    cv2.fillPoly(
        image, [np.array([at(*corner) for corner in torso], np.int32)], walker.coat, cv2.LINE_AA, SUBPIXEL_BITS
    )
    limb((0, 84), (0, 90), thick=6, colour=skin)
    for centre, axes, arc, colour in (((0, 93), (5.5, 7), (0, 360), skin), ((0, 96), (5.6, 5), (180, 360), hair)):
        half = (round(axes[0] * unit * scale), round(axes[1] * unit * scale))
        cv2.ellipse(image, at(*centre), half, 0, *arc, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    reach = 17.0
    return Box(middle - reach * unit, walker.feet - 100 * unit, 2 * reach * unit, 100 * unit)
