"""The detector finds the people that the camera filmed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from examples.human_detection.camera import HEIGHT, WIDTH, Box, film
from examples.human_detection.detector import PeopleDetector

if TYPE_CHECKING:
    from pathlib import Path

FRAMES = 4


def test_people_are_found_where_they_are() -> None:
    detector, found = PeopleDetector(), 0
    for frame in film(FRAMES, seed=3):
        assert 100_000 <= len(frame.jpeg) <= 160_000
        size, people = detector.find(frame.jpeg)
        assert size == (WIDTH, HEIGHT)
        assert [person.score for person in people] == sorted((person.score for person in people), reverse=True)
        boxes = [Box(person.x, person.y, person.width, person.height) for person in people]
        found += sum(max(body.overlap(box) for box in boxes) > 0.5 for body in frame.people)
    assert found >= 2 * FRAMES


def test_an_empty_room_has_nobody_in_it() -> None:
    encoded, image = cv2.imencode(".png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    assert encoded
    assert PeopleDetector().find(image.tobytes()) == ((WIDTH, HEIGHT), [])


def test_an_image_smaller_than_a_person_has_nobody_in_it() -> None:
    encoded, image = cv2.imencode(".png", np.zeros((20, 30), np.uint8))
    assert encoded
    assert PeopleDetector().find(image.tobytes()) == ((30, 20), [])


@pytest.mark.parametrize("encoded", [b"", b"\xff\xd8\xff", b"not an image" * 100])
def test_what_is_no_image_is_refused(encoded: bytes) -> None:
    with pytest.raises(ValueError, match="not a JPEG or PNG image"):
        PeopleDetector().find(encoded)


def test_a_film_is_the_same_for_the_same_seed() -> None:
    assert film(2, seed=5) == film(2, seed=5)
    assert film(1, seed=5)[0].jpeg != film(1, seed=6)[0].jpeg


def test_an_unreadable_photograph_is_refused(tmp_path: Path) -> None:
    photograph = tmp_path / "empty.jpg"
    photograph.touch()
    with pytest.raises(ValueError, match=r"empty\.jpg: not a readable image"):
        film(1, seed=1, photograph=photograph)


def test_overlap() -> None:
    box = Box(0, 0, 10, 10)
    assert box.overlap(box) == 1.0
    assert box.overlap(Box(5, 0, 10, 10)) == pytest.approx(1 / 3)
    assert box.overlap(Box(10, 0, 10, 10)) == 0.0
