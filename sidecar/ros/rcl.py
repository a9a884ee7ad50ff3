"""Takes and sends requests and answers as bytes, through rcl's public C functions.

rclpy hands over messages of services only as Python objects, and makes and reads them field by field. That takes 20 to
50 microseconds for each pose of a path, with the interpreter lock held. The bridge needs bytes. So rclpy creates the
services and clients, but the bridge takes and sends through the C functions that rclpy itself calls, with the C
messages that each type's own type support makes. These parts of the C structures are used, unchanged since ROS 2
Humble:

    rmw_request_id_t       { uint8_t writer_guid[16]; int64_t sequence_number; }
    rcutils_uint8_array_t  { uint8_t * buffer; size_t length, capacity; rcutils_allocator_t allocator; }
    rmw_qos_profile_t, rmw_subscription_options_t (since Humble): `_Qos` and `_SubscriptionOptions` below

Functions that take microseconds are called with the interpreter lock held; those that may block or move much memory,
without it. All of this belongs to one thread: rcl keeps its error text per thread.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from plr.sidecar.ros.cdr_layouts import layout_of
from plr.sidecar.ros.cdr_walk import CdrError, check
from plr.sidecar.ros.errors import RosBridgeError

_OK = 0
_TIMEOUT = 2
_CLIENT_TAKE_FAILED = 501
_SERVICE_TAKE_FAILED = 601
_ERROR_TEXT_BYTES = 1024
"""RCUTILS_ERROR_MESSAGE_MAX_LENGTH"""
_KEEP_LAST = _RELIABLE = _TRANSIENT_LOCAL = 1
"""Values of rmw_qos_history_policy_e, rmw_qos_reliability_policy_e and rmw_qos_durability_policy_e."""
MAX_UNKNOWN_BYTES = 1 << 20
"""Maximum size of a message of unknown layout: to read it, a type support may take a hundred times as much memory."""
LARGE_MESSAGE_BYTES = 65_536
"""From this size on, a copy takes longer than passing the interpreter lock to another thread and back (tens of µs)."""

FIRST_BUFFER_BYTES = 4096
"""Initial size, enough for most requests; the buffer doubles as needed."""


class RclError(RosBridgeError):
    """rcl or rmw failed for a reason other than the bytes."""


class NewClientError(RclError):
    """The client that sent the request is not fully discovered yet; its answer can be sent later."""


class RmwRequestId(ctypes.Structure):
    """The client that sent a request, and the number it gave the request."""

    _fields_ = (("writer_guid", ctypes.c_uint8 * 16), ("sequence_number", ctypes.c_int64))


class _Allocator(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    )


class _Bytes(ctypes.Structure):
    _fields_ = (
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


class _View(ctypes.Structure):
    """The same structure over the memory of a Python bytes object."""

    _fields_ = (
        ("buffer", ctypes.c_char_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


class _ErrorText(ctypes.Structure):
    _fields_ = (("text", ctypes.c_char * _ERROR_TEXT_BYTES),)


class _Time(ctypes.Structure):
    """A duration; zero means the rmw's default, which is unlimited."""

    _fields_ = (("seconds", ctypes.c_uint64), ("nanoseconds", ctypes.c_uint64))


class _Qos(ctypes.Structure):
    _fields_ = (
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline", _Time),
        ("lifespan", _Time),
        ("liveliness", ctypes.c_int),
        ("liveliness_lease", _Time),
        ("no_name_conventions", ctypes.c_bool),
    )


class _SubscriptionOptions(ctypes.Structure):
    _fields_ = (
        ("payload", ctypes.c_void_p),
        ("ignore_local", ctypes.c_bool),
        ("unique_endpoints", ctypes.c_int),
        ("content_filter", ctypes.c_void_p),
    )


class _Functions:
    """The C functions, through a loader that holds (PyDLL) or releases (CDLL) the interpreter lock."""

    def __init__(self, loader: Any) -> None:
        # Exactly the library that rclpy has loaded; its symbols include those of rmw and rcutils below it.
        rcl = loader("librcl.so", mode=os.RTLD_NOW | os.RTLD_NOLOAD)
        pointer, status = ctypes.c_void_p, ctypes.c_int
        request_id = ctypes.POINTER(RmwRequestId)
        self.take_request = _prototype(rcl.rcl_take_request, status, pointer, request_id, pointer)
        self.take_response = _prototype(rcl.rcl_take_response, status, pointer, request_id, pointer)
        self.send_response = _prototype(rcl.rcl_send_response, status, pointer, request_id, pointer)
        self.send_request = _prototype(rcl.rcl_send_request, status, pointer, pointer, ctypes.POINTER(ctypes.c_int64))
        self.serialize = _prototype(rcl.rmw_serialize, status, pointer, pointer, ctypes.POINTER(_Bytes))
        self.deserialize = _prototype(rcl.rmw_deserialize, status, ctypes.POINTER(_View), pointer, pointer)
        self.default_allocator = _prototype(rcl.rcutils_get_default_allocator, _Allocator)
        self.bytes_init = _prototype(
            rcl.rcutils_uint8_array_init,
            status,
            ctypes.POINTER(_Bytes),
            ctypes.c_size_t,
            ctypes.POINTER(_Allocator),
        )
        self.bytes_resize = _prototype(rcl.rcutils_uint8_array_resize, status, ctypes.POINTER(_Bytes), ctypes.c_size_t)
        self.bytes_fini = _prototype(rcl.rcutils_uint8_array_fini, status, ctypes.POINTER(_Bytes))
        self.node_rmw_handle = _prototype(rcl.rcl_node_get_rmw_handle, pointer, pointer)
        self.graph_guard = _prototype(rcl.rcl_node_get_graph_guard_condition, pointer, pointer)
        self.wait_for_guard = _prototype(rcl.rcl_wait_set_add_guard_condition, status, pointer, pointer, pointer)
        self.subscription_options = _prototype(rcl.rmw_get_default_subscription_options, _SubscriptionOptions)
        self.create_subscription = _prototype(
            rcl.rmw_create_subscription,
            pointer,
            pointer,
            pointer,
            ctypes.c_char_p,
            ctypes.POINTER(_Qos),
            ctypes.POINTER(_SubscriptionOptions),
        )
        self.destroy_subscription = _prototype(rcl.rmw_destroy_subscription, status, pointer, pointer)
        self.take = _prototype(rcl.rmw_take, status, pointer, pointer, ctypes.POINTER(ctypes.c_bool), pointer)
        self.error_text = _prototype(rcl.rcutils_get_error_string, _ErrorText)
        self.reset_error = _prototype(rcl.rcutils_reset_error, None)


def _prototype(function: Any, result: Any, *arguments: Any) -> Any:
    function.restype = result
    function.argtypes = arguments
    return function


_rclpy.rclpy_get_rmw_implementation_identifier()  # loads rclpy's C part, and librcl with it
_holding = _Functions(ctypes.PyDLL)
_releasing = _Functions(ctypes.CDLL)

_capsule_name = _prototype(ctypes.pythonapi.PyCapsule_GetName, ctypes.c_char_p, ctypes.py_object)
_capsule_pointer = _prototype(ctypes.pythonapi.PyCapsule_GetPointer, ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
_Create = ctypes.PYFUNCTYPE(ctypes.c_void_p)
_Destroy = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)


def _unwrap(capsule: Any) -> int:
    return int(_capsule_pointer(capsule, _capsule_name(capsule)))


def _take_error() -> str:
    text: bytes = _holding.error_text().text
    _holding.reset_error()
    return text.decode(errors="replace")


class Message:
    """A C message; freed with this object."""

    __slots__ = ("_destroy", "pointer")

    def __init__(self, pointer: int, destroy: Any) -> None:
        self.pointer = pointer
        self._destroy = destroy

    def __del__(self) -> None:
        self._destroy(self.pointer)


class MessageType:
    """Converts messages of one generated class, its type support loaded, to and from CDR with its 4-byte header."""

    __slots__ = (
        "_buffer",
        "_clean_capacity",
        "_create",
        "_destroy",
        "_last_length",
        "_layout",
        "name",
        "type_support",
    )

    def __init__(self, message_class: Any) -> None:
        self.name: str = message_class.__name__
        self._layout = layout_of(message_class)
        meta = type(message_class)
        if meta._TYPE_SUPPORT is None:
            meta.__import_type_support__()
        self.type_support = _unwrap(meta._TYPE_SUPPORT)
        self._create = _Create(_unwrap(meta._CREATE_ROS_MESSAGE))
        self._destroy = _Destroy(_unwrap(meta._DESTROY_ROS_MESSAGE))
        self._last_length = 0
        self._buffer = _Bytes()
        if _holding.bytes_init(self._buffer, 0, _holding.default_allocator()) != _OK:
            raise RclError(f"cannot create a buffer: {_take_error()}")
        self._clean_capacity = 0
        self._grow_buffer(FIRST_BUFFER_BYTES)

    def __del__(self) -> None:
        _holding.bytes_fini(self._buffer)

    def functions(self) -> _Functions:
        """Return the variant to call for the next message of this type, judged by the size of the last one."""
        return _releasing if self._last_length >= LARGE_MESSAGE_BYTES else _holding

    def new(self) -> Message:
        """Return an empty message."""
        pointer = self._create()
        if not pointer:
            raise RclError(f"cannot create a {self.name}")
        return Message(pointer, self._destroy)

    def serialize(self, message: Message) -> bytes:
        """Return the bytes of `message`."""
        # Fast CDR does not write padding: old content of the buffer, an earlier message or other memory of this
        # process, must not reach a peer in it. So the buffer is zeroed first, and a message that made it grow is
        # serialised again.
        buffer = self._buffer
        ctypes.memset(buffer.buffer, 0, buffer.length)
        self._fill_buffer(message)
        if buffer.capacity != self._clean_capacity:
            self._grow_buffer(2 * buffer.capacity)
            self._fill_buffer(message)
        self._last_length = buffer.length
        return ctypes.string_at(buffer.buffer, buffer.length)

    def _fill_buffer(self, message: Message) -> None:
        if self.functions().serialize(message.pointer, self.type_support, self._buffer) != _OK:
            raise RclError(f"cannot serialise {self.name}: {_take_error()}")

    def _grow_buffer(self, capacity: int) -> None:
        if _holding.bytes_resize(self._buffer, capacity) != _OK:
            raise RclError(f"no memory for {capacity} bytes: {_take_error()}")
        ctypes.memset(self._buffer.buffer, 0, capacity)
        self._clean_capacity = capacity

    def deserialize(self, payload: bytes | memoryview) -> Message:
        """Return the message in `payload`, or raise RosBridgeError.

        Hostile bytes neither crash the type support nor make it allocate more than a small multiple of their size: they
        are checked before it reads them (tests/ros/hostile_bytes.py).
        """
        self._check(payload)
        message = self.new()
        payload = bytes(payload)
        self._last_length = len(payload)
        view = _View(payload, len(payload), len(payload))
        if self.functions().deserialize(view, self.type_support, message.pointer) != _OK:
            raise RosBridgeError(f"the bytes are not a {self.name}: {_take_error()}")
        return message

    def _check(self, payload: bytes | memoryview) -> None:
        if self._layout is None:
            if len(payload) > MAX_UNKNOWN_BYTES:
                many = f"{len(payload)} bytes, but at most {MAX_UNKNOWN_BYTES} are allowed"
                raise RosBridgeError(
                    f"{many} for a {self.name}: it has fields of a kind that cannot be checked in advance"
                )
            return
        try:
            check(self._layout, payload)
        except CdrError as error:
            raise RosBridgeError(f"the bytes are not a {self.name} that is accepted: {error}") from error


def take_request(service: int, request_type: MessageType) -> tuple[RmwRequestId, bytes] | None:
    """Take the next request from the rcl service at this address, or return None."""
    request_id = RmwRequestId()
    message = request_type.new()
    status = request_type.functions().take_request(service, request_id, message.pointer)
    if status == _SERVICE_TAKE_FAILED:
        return None
    if status != _OK:
        raise RclError(f"cannot take a request ({status}): {_take_error()}")
    return request_id, request_type.serialize(message)


def take_response(client: int, response_type: MessageType) -> tuple[int, bytes] | None:
    """Take the next response to the rcl client at this address: (number of its request, bytes), or None."""
    request_id = RmwRequestId()
    message = response_type.new()
    status = response_type.functions().take_response(client, request_id, message.pointer)
    if status == _CLIENT_TAKE_FAILED:
        return None
    if status != _OK:
        raise RclError(f"cannot take a response ({status}): {_take_error()}")
    return request_id.sequence_number, response_type.serialize(message)


def send_response(service: int, request_id: RmwRequestId, response: Message) -> None:
    """Answer a request; rmw may wait up to 0.1 s for a client it has only just discovered.

    Raises:
        NewClientError: that time was not enough.
        RclError: the response cannot be sent.
    """
    status = _releasing.send_response(service, request_id, response.pointer)
    if status == _TIMEOUT:
        raise NewClientError(_take_error())
    if status != _OK:
        raise RclError(f"cannot send a response ({status}): {_take_error()}")


def send_request(client: int, request: Message) -> int:
    """Send a request; return the number that rmw gave it."""
    number = ctypes.c_int64()
    status = _releasing.send_request(client, request.pointer, number)
    if status != _OK:
        raise RclError(f"cannot send a request ({status}): {_take_error()}")
    return number.value


def graph_guard(node: int) -> int:
    """Return the address of the guard condition that rcl triggers when the ROS graph of the rcl node changes."""
    guard = _holding.graph_guard(node)
    if not guard:
        raise RclError(f"cannot get the guard condition of the graph: {_take_error()}")
    return int(guard)


def wait_for_guard(wait_set: int, guard: int) -> None:
    """Let the next wait on the rcl wait set end when this guard condition is triggered."""
    status = _holding.wait_for_guard(wait_set, guard, None)
    if status != _OK:
        raise RclError(f"cannot wait for the graph ({status}): {_take_error()}")


class LatchedTopic:
    """A reader of each publisher's last messages on a topic, including those sent before this reader existed.

    The topic's name is the plain DDS name: rcl gives no access to the topics of rmw itself.
    """

    def __init__(self, node: int, name: str, message_type: MessageType, depth: int) -> None:
        self._node = _holding.node_rmw_handle(node)
        self._type = message_type
        qos = _Qos(
            history=_KEEP_LAST,
            depth=depth,
            reliability=_RELIABLE,
            durability=_TRANSIENT_LOCAL,
            no_name_conventions=True,
        )
        options = _holding.subscription_options()
        self._pointer = _releasing.create_subscription(
            self._node, message_type.type_support, name.encode(), qos, options
        )
        if not self._pointer:
            raise RclError(f"cannot read {name}: {_take_error()}")

    def take(self) -> bytes | None:
        """Take the next message, or return None."""
        message, taken = self._type.new(), ctypes.c_bool()
        status = _holding.take(self._pointer, message.pointer, taken, None)
        if status != _OK:
            raise RclError(f"cannot take a message ({status}): {_take_error()}")
        return self._type.serialize(message) if taken.value else None

    def close(self) -> None:
        """Destroy the reader."""
        pointer, self._pointer = self._pointer, None
        if pointer:
            _releasing.destroy_subscription(self._node, pointer)
