from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.sidecar.local.protocol import PingRequest, StateRequest, decode_request

pytestmark = pytest.mark.audit("ops-14")


def test_requests() -> None:
    assert decode_request(b'{"id": 1, "ask": "state"}') == StateRequest(1)
    assert decode_request(b'{"id": 2, "ask": "ping", "peer": "cloud-1", "size": 64}') == PingRequest(
        2, "cloud-1", None, 64
    )


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["id", "ask", "peer", "size", "interface"]), inner, max_size=5)
    ),
    max_leaves=8,
)


@settings(max_examples=50)
@given(JSON.map(lambda value: json.dumps(value).encode()) | st.binary(max_size=200))
def test_anything_is_a_request_or_refused(line: bytes) -> None:
    try:
        request = decode_request(line)
    except DecodeError:
        return
    assert isinstance(request, StateRequest | PingRequest)
