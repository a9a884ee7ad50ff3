"""OpenCV's people detector: histograms of oriented gradients and a linear SVM (Dalal and Triggs, 2005)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Larger images are made smaller first: people are large in them, and the detector's time goes with the area.
SEARCH_WIDTH = 640
WINDOW_STRIDE = (8, 8)
PYRAMID_STEP = 1.05
# The detector was trained on windows of 64x128 pixels with 16 pixels around the person: what it finds is the window.
MARGIN_X, MARGIN_Y = 16 / 64, 16 / 128
# SVM scores below this are mostly furniture.
MIN_SCORE = 0.5


@dataclass(frozen=True, slots=True)
class Person:
    """One person found; pixels of the image that was given, `score` is the SVM's."""

    x: int
    y: int
    width: int
    height: int
    score: float


class PeopleDetector:
    """Finds whole, upright people in encoded images."""

    def __init__(self) -> None:
        self._hog = cv2.HOGDescriptor()
        self._hog.setSVMDetector(cv2.HOGDescriptor.getDefaultPeopleDetector())

    def find(self, encoded: bytes) -> tuple[tuple[int, int], list[Person]]:
        """The image's (width, height) and the people in it, surest first. Raises ValueError if it can't be decoded."""
        image = None
        if encoded:
            image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError("not a JPEG or PNG image")
        height, width = image.shape
        shrink = min(1.0, SEARCH_WIDTH / width)
        small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        if small.shape[0] < self._hog.winSize[1] or small.shape[1] < self._hog.winSize[0]:
            return (width, height), []
        boxes, scores = self._hog.detectMultiScale(small, winStride=WINDOW_STRIDE, scale=PYRAMID_STEP)
        people = [
            _person(box / shrink, float(score))
            for box, score in zip(boxes, np.ravel(scores), strict=True)
            if score >= MIN_SCORE
        ]
        return (width, height), sorted(people, key=lambda person: -person.score)


def _person(window: NDArray[np.float64], score: float) -> Person:
    x, y, width, height = (float(edge) for edge in window)
    left, top = MARGIN_X * width, MARGIN_Y * height
    return Person(round(x + left), round(y + top), round(width - 2 * left), round(height - 2 * top), score)
