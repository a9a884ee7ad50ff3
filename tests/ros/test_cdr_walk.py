"""The walk over a message's bytes: it accepts what the type support writes, whatever it is, and no bomb."""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
import random
import struct
import time
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rcl_interfaces.msg import ParameterValue
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import check_for_type_support
from rosidl_parser import definition
from sensor_msgs.msg import CompressedImage, Image

from plr.sidecar.ros import cdr_walk
from plr.sidecar.ros.cdr_layouts import layout_of
from plr.sidecar.ros.cdr_walk import CdrError, Layout, check

pytestmark = [pytest.mark.ros, pytest.mark.audit("sec-3")]

PACKAGES = (
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "plr_demo_interfaces",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "type_description_interfaces",
)
RMWError = rclpy_implementation.RMWError
LITTLE_ENDIAN = b"\0\1\0\0"


def message_classes() -> list[Any]:
    """Every message of the packages, those of services included."""
    found = []
    for package in PACKAGES:
        for kind in ("msg", "srv"):
            try:
                module = importlib.import_module(f"{package}.{kind}")
            except ModuleNotFoundError:
                continue
            for _, name, _ in pkgutil.iter_modules(module.__path__):
                inner = importlib.import_module(f"{package}.{kind}.{name}")
                classes = (one for one in vars(inner).values() if hasattr(one, "SLOT_TYPES"))
                found += [one for one in classes if one.__module__ == inner.__name__]
    return found


CLASSES = message_classes()


def filled(slot: Any, rng: random.Random, depth: int = 0) -> Any:
    """A value for a field."""
    match slot:
        case definition.BasicType(typename="boolean"):
            return rng.random() < 0.5
        case definition.BasicType(typename="octet"):
            return rng.randbytes(1)
        case definition.BasicType(typename="float" | "double"):
            return float(rng.randrange(100))
        case definition.BasicType():
            return rng.randrange(100)
        case definition.UnboundedString() | definition.BoundedString():
            return "x" * rng.choice((0, 1, 3, 4, 17))
        case definition.Array(size=size):
            return [filled(slot.value_type, rng, depth + 1) for _ in range(size)]
        case definition.UnboundedSequence() | definition.BoundedSequence():
            most = 3 if depth > 2 else 40
            length = min(rng.choice((0, 1, 2, most)), getattr(slot, "maximum_size", most))
            alike = filled(slot.value_type, rng, depth + 1)
            return [alike if rng.random() < 0.8 else filled(slot.value_type, rng, depth + 1) for _ in range(length)]
        case definition.NamespacedType():
            module = importlib.import_module(".".join(slot.namespaces))
            return message_of(getattr(module, slot.name), rng, depth + 1)
        case _:
            raise AssertionError(slot)


def message_of(kind: Any, rng: random.Random, depth: int = 0) -> Any:
    message = kind()
    for name, slot in zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True):
        setattr(message, name, filled(slot, rng, depth))
    return message


def known_layout(kind: Any) -> Layout:
    layout = layout_of(kind)
    assert layout is not None
    return layout


def end_of(layout: Any, payload: bytes) -> int:
    walk = cdr_walk.Walk(memoryview(payload)[4:], "<", 1 << 40)
    return 4 + int(layout.walk(walk, 0))


def test_every_installed_message_is_accepted_to_its_very_end() -> None:
    """The walk must agree with the type support, or an honest message is lost."""
    rng = random.Random(1)
    assert len(CLASSES) > 150
    messages = needed = 0
    for kind in CLASSES:
        layout = known_layout(kind)
        check_for_type_support(kind)
        for _ in range(5):
            message = message_of(kind, rng)
            payload = serialize_message(message)
            check(layout, payload)
            # Fast CDR announces more than it writes.
            end = end_of(layout, payload)
            assert deserialize_message(payload[:end], kind) == message
            try:
                deserialize_message(payload[: end - 1], kind)
            except RMWError:
                needed += 1
            messages += 1
            with pytest.raises(CdrError):
                check(layout, payload[: end - 1])
    # It reads a byte too many now and then, where what follows in memory lets it.
    assert needed > 0.9 * messages


def test_what_is_not_known_is_told() -> None:
    class Wide:
        SLOT_TYPES = (definition.UnboundedWString(),)

    class Deep:
        SLOT_TYPES: tuple[Any, ...] = ()

    Deep.SLOT_TYPES = (definition.NamespacedType(["builtin_interfaces", "msg"], "Deep"),)
    assert layout_of(Wide) is None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtin_interfaces.msg.Deep", Deep, raising=False)
        assert layout_of(Deep) is None


def poses(count: int, frame: str = "map") -> bytes:
    path = Path()
    pose = PoseStamped()
    pose.header.frame_id = frame
    path.poses = [pose] * count
    return bytes(serialize_message(path))


@pytest.mark.parametrize("frame", ["map", "m", "", "a/frame/of/some/length"])
def test_elements_that_look_alike_are_skipped_together(frame: str) -> None:
    walk = cdr_walk.Walk(memoryview(poses(100_000, frame))[4:], "<", 1 << 40)
    assert known_layout(Path).walk(walk, 0) <= walk.end
    assert walk.steps_left > cdr_walk.MAX_WALK_STEPS - 100


def test_those_that_differ_are_walked_up_to_a_limit() -> None:
    rng, value = random.Random(1), ParameterValue()
    value.string_array_value = ["x" * rng.randrange(100) for _ in range(19_000)]
    check(known_layout(ParameterValue), serialize_message(value))
    value.string_array_value = ["x" * rng.randrange(100) for _ in range(100_000)]
    with pytest.raises(CdrError, match="strings and sequences of different lengths"):
        check(known_layout(ParameterValue), serialize_message(value))


def test_paths_within_others_are_skipped_as_well() -> None:
    one = poses(5_000)[4:]
    one += bytes(-len(one) % 8)
    walk = cdr_walk.Walk(memoryview(one * 40), "<", 1 << 40)
    assert cdr_walk.array(known_layout(Path), 40).walk(walk, 0) <= walk.end
    assert walk.steps_left > cdr_walk.MAX_WALK_STEPS - 40 * 100


def test_no_bytes_of_16_mib_take_much_memory_or_time() -> None:
    """Zeros with one length among them, at every place near the beginning."""
    size, slowest = 16 << 20, ("", 0.0)
    payload = bytearray(size)
    payload[:4] = LITTLE_ENDIAN
    for kind in CLASSES:
        layout = known_layout(kind)
        for word in range(8):
            at = slice(4 + 4 * word, 8 + 4 * word)
            for announced in (size - 64, size // 4, size // 24, size // 72, 1 << 31):
                payload[at] = struct.pack("<I", announced)
                began = time.thread_time()
                try:
                    memory = check(layout, memoryview(payload))
                except CdrError:
                    memory = 0
                slowest = max(slowest, (kind.__name__, time.thread_time() - began), key=lambda one: one[1])
                assert memory <= 3 * size
            payload[at] = bytes(4)
    assert slowest[1] < 2.0, f"walked, instead of skipped or refused: generous for a busy machine: {slowest}"


@pytest.mark.parametrize("strings", [1, 2, 8])
@pytest.mark.parametrize("blocks_alike", [1, 15, 31])
def test_runs_that_end_just_after_they_were_found_take_no_longer_than_lengths(strings: int, blocks_alike: int) -> None:
    """Each run is compared, in vain but for a few: 0.19 s, before a comparison was counted."""
    element = cdr_walk.structure([cdr_walk.String()] * strings)
    layout = cdr_walk.structure([cdr_walk.Elements(element)])
    run = cdr_walk.ALIGNMENT * (1 + blocks_alike) * strings
    short, long = struct.pack("<I4s", 4, b"abc"), struct.pack("<I8s", 8, b"abcdefg")
    runs = 200_000 // run
    body = b"".join((long if number % 2 else short) * run for number in range(runs))
    walk = cdr_walk.Walk(memoryview(struct.pack("<I", runs * run // strings) + body), "<", 1 << 40)
    began = time.thread_time()
    with contextlib.suppress(CdrError):
        layout.walk(walk, 0)
    took_s = time.thread_time() - began
    walk.steps_left = cdr_walk.MAX_WALK_STEPS
    plain = b"".join((long if number % 3 else short) for number in range(cdr_walk.MAX_WALK_STEPS // 2))
    walk = cdr_walk.Walk(memoryview(struct.pack("<I", cdr_walk.MAX_WALK_STEPS // 2) + plain), "<", 1 << 40)
    began = time.thread_time()
    with contextlib.suppress(CdrError):
        cdr_walk.structure([cdr_walk.Elements(cdr_walk.String())]).walk(walk, 0)
    one_by_one_s = 2 * (time.thread_time() - began)
    assert took_s < 2 * one_by_one_s, (took_s, one_by_one_s)


def test_a_small_message_of_short_strings_is_no_bomb() -> None:
    value = ParameterValue(string_array_value=[""] * 100_000)
    payload = serialize_message(value)
    assert check(known_layout(ParameterValue), payload) > 3 * len(payload)
    value = ParameterValue(string_array_value=[""] * 1_000_000)
    with pytest.raises(CdrError, match="bytes of memory"):
        check(known_layout(ParameterValue), serialize_message(value))


def test_images_of_any_size_cost_nothing() -> None:
    image = Image(data=bytes(8 << 20), encoding="rgb8", height=1000, width=2000, step=6000)
    assert check(known_layout(Image), serialize_message(image)) < 9 << 20
    check(known_layout(CompressedImage), serialize_message(CompressedImage(format="jpeg", data=bytes(1 << 20))))


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"", "shorter than its header"),
        (b"\0\1", "shorter than its header"),
        (b"\0\7\0\0" + bytes(100), "not plain CDR"),
        (b"\0\3\0\0" + bytes(100), "not plain CDR"),
        (LITTLE_ENDIAN, "truncated"),
        (LITTLE_ENDIAN + bytes(8) + b"\xff\xff\xff\xff", "a string of 4294967295 bytes, 0 left"),
    ],
)
def test_what_is_no_message(payload: bytes, why: str) -> None:
    with pytest.raises(CdrError, match=why):
        check(known_layout(Path), payload)


def test_bounds_hold() -> None:
    text = cdr_walk.structure([cdr_walk.String(3)])
    check(text, LITTLE_ENDIAN + struct.pack("<I", 4) + b"abc\0")
    with pytest.raises(CdrError, match="at most 3"):
        check(text, LITTLE_ENDIAN + struct.pack("<I", 5) + b"abcd\0")
    numbers = cdr_walk.structure([cdr_walk.Elements(cdr_walk.primitive(8), 2)])
    check(numbers, LITTLE_ENDIAN + struct.pack("<II", 2, 0) + bytes(16))
    with pytest.raises(CdrError, match="at most 2"):
        check(numbers, LITTLE_ENDIAN + struct.pack("<II", 3, 0) + bytes(24))


def test_both_byte_orders() -> None:
    path = cdr_walk.structure([cdr_walk.String()])
    assert check(path, b"\0\0\0\0" + struct.pack(">I", 4) + b"abc\0") > 0
    with pytest.raises(CdrError):
        check(path, LITTLE_ENDIAN + struct.pack(">I", 4) + b"abc\0")
