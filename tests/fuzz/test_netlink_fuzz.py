from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plr.sidecar.net.netlink_watch import read_announcements


@given(st.binary(max_size=200))
def test_announcements_of_any_bytes_are_read_to_an_end(data: bytes) -> None:
    gone: dict[int, bool] = {}
    assert read_announcements(data, gone) in (True, False)
