"""Whatever stands in a node's folder or a CA's index: it is refused with ConfigError in one line, or good."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.ca import Authority
from plr.controlplane.ca.index import decode_index, encode_index
from plr.protos.base.errors import ConfigError
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from collections.abc import Iterator

CA = Authority.create()
ISSUED = CA.issue("robot-1", IdentityRole.ROBOT)
CA.issue("robot-2", IdentityRole.ROBOT)
CA.revoke("robot-2")
GOOD = {
    "ca.pem": CA.ca_pem,
    "cert.pem": ISSUED.certificate_pem,
    "crl.pem": CA.crl_pem(),
    "key.pem": ISSUED.key_pem,
}
INDEX = encode_index([CA.record()])


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    changed = bytearray(data)
    for place, value in draw(st.lists(st.tuples(st.integers(0, len(data) - 1), st.integers(0, 255)), max_size=4)):
        changed[place] = value
    start = draw(st.integers(0, len(data)))
    return bytes(changed[:start] + draw(st.binary(max_size=20)) + changed[start + draw(st.integers(0, 50)) :])


@contextlib.contextmanager
def refused_in_one_line() -> Iterator[None]:
    """Let ConfigError pass, if it is one line, and no other error."""
    problem = ""
    try:
        yield
    except ConfigError as error:
        problem = str(error)
    assert "\n" not in problem


@pytest.mark.parametrize("name", GOOD)
@given(st.data())
def test_a_damaged_folder(name: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for each, content in GOOD.items():
            (folder / each).write_bytes(data.draw(damaged(content)) if each == name else content)
        (folder / "key.pem").chmod(0o600)
        with refused_in_one_line():
            assert load_tls_files(folder).identity.name == "robot-1"


@given(damaged(INDEX))
def test_a_damaged_index(data: bytes) -> None:
    with refused_in_one_line():
        (record,) = decode_index(data, Path("index.json"))
        assert encode_index([record])


@given(st.binary(max_size=200))
def test_any_bytes_as_index(data: bytes) -> None:
    with pytest.raises(ConfigError):
        decode_index(data, Path("index.json"))
