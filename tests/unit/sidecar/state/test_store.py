from __future__ import annotations

import errno
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING

import pytest

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import Candidate, CandidateKind, Peer, PeerSet, ServiceOffer
from plr.protos.model.stream import Welcome
from plr.protos.program import own_folder
from plr.sidecar.state import store as state_store
from plr.sidecar.state.file import (
    ControlAddresses,
    LastGood,
    SavedIdentity,
    decode_addresses,
    decode_identity,
    decode_last_good,
    encode_addresses,
    encode_identity,
    encode_last_good,
)
from plr.sidecar.state.store import (
    ADDRESSES_FILE,
    CLOCK_FILE,
    IDENTITY_FILE,
    LAST_GOOD_FILE,
    REVOCATIONS_FILE,
    StateDirError,
    StateStore,
)

if TYPE_CHECKING:
    from collections.abc import Callable

OWNER = NodeName("robot-1")
WELCOME = Welcome(lease_s=3.0, report_interval_s=0.5, stun_servers=("192.0.2.9:3478", "stun.example.org:3478"))
PEERS = PeerSet(
    Version(11),
    nonce=3,
    peers=(
        Peer(
            NodeName("cloud-a"),
            Role.CLOUD,
            SessionId(99),
            bytes(range(16)),
            incarnation=5,
            candidates=(Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, ("192.0.2.1", 24700)),),
            offers=(ServiceOffer(ServiceName("/plan"), "nav_msgs/srv/GetPlan"),),
        ),
    ),
)
MAPPING = MappingSet(
    Version(12),
    nonce=4,
    services=(
        ServiceMapping(ServiceName("/plan"), (Assignment(InterfaceName("wlan0"), NodeName("cloud-a")),), 0.25, "why"),
    ),
)
EVERYTHING = LastGood(OWNER, WELCOME, PEERS, MAPPING)


def reopen(store: StateStore, folder: Path) -> StateStore:
    store.close()
    return StateStore(folder, OWNER)


def test_a_first_start_finds_nothing_and_gets_an_identity(tmp_path: Path) -> None:
    store = StateStore(tmp_path / "new" / "folder", OWNER)
    assert store.last_good == LastGood(OWNER)
    assert len(store.identity.token) == 16
    assert store.identity.token != bytes(16)
    assert not store.failures
    store.close()


def test_the_token_stays_and_the_incarnation_grows_with_every_start(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    identities = [store.identity]
    for _ in range(3):
        store = reopen(store, tmp_path)
        identities.append(store.identity)
    store.close()
    assert len({identity.token for identity in identities}) == 1
    numbers = [identity.incarnation for identity in identities]
    assert numbers == sorted(set(numbers))


def test_the_incarnation_grows_although_the_clock_went_back(tmp_path: Path) -> None:
    ahead = SavedIdentity(bytes(range(16)), incarnation=int((time.time() + 1e6) * 1000))
    (tmp_path / IDENTITY_FILE).write_bytes(encode_identity(ahead))
    store = StateStore(tmp_path, OWNER)
    assert store.identity == SavedIdentity(ahead.token, ahead.incarnation + 1)
    store.close()


def test_two_sidecars_have_different_tokens(tmp_path: Path) -> None:
    stores = [StateStore(tmp_path / name, OWNER) for name in ("a", "b")]
    assert stores[0].identity.token != stores[1].identity.token
    for store in stores:
        store.close()


def test_what_was_in_force_is_found_after_a_restart(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    for message in (WELCOME, PEERS, MAPPING):
        store.remember(message)
    store = reopen(store, tmp_path)
    assert store.last_good == EVERYTHING
    newer = MappingSet(Version(13), nonce=1)
    store.remember(newer)
    store = reopen(store, tmp_path)
    assert store.last_good == LastGood(OWNER, WELCOME, PEERS, newer)
    assert not store.failures
    store.close()


def test_addresses_of_a_control_plane_are_found_under_the_names_that_are_configured(tmp_path: Path) -> None:
    names = ("cp.example:50051", "[2001:db8::1]:50051")
    addresses = (("192.0.2.1", 50051), ("2001:db8::1", 50051))
    store = StateStore(tmp_path, OWNER)
    assert store.control_addresses(names) == ()
    store.remember_addresses(names, addresses)
    store = reopen(store, tmp_path)
    assert store.control_addresses(names) == addresses
    assert store.control_addresses(names[:1]) == ()
    store.close()
    (tmp_path / ADDRESSES_FILE).write_bytes(b"spoilt")
    store = StateStore(tmp_path, OWNER)
    assert store.control_addresses(names) == ()
    assert store.failures == {"control_addresses_refused": 1}
    store.close()


@pytest.mark.audit("sec-12")
def test_revocation_lists_are_found_again_wherever_they_came_from(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    assert store.revocations == b""
    store.remember_revocations(b"PEM")
    store = reopen(store, tmp_path)
    assert store.revocations == b"PEM"
    store.close()
    (tmp_path / REVOCATIONS_FILE).write_bytes(b"spoilt")
    store = StateStore(tmp_path, OWNER)
    assert store.revocations == b""
    assert store.failures == {"revocations_refused": 1}
    store.close()


@pytest.mark.audit("sec-9")
def test_the_clocks_floor_is_found_again(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    assert store.clock_floor == 0.0
    store.remember_clock_floor(1_800_000_000.5)
    store = reopen(store, tmp_path)
    assert store.clock_floor == 1_800_000_000.5
    store.close()
    (tmp_path / CLOCK_FILE).write_bytes(b"spoilt")
    store = StateStore(tmp_path, OWNER)
    assert store.clock_floor == 0.0
    assert store.failures == {"clock_floor_refused": 1}
    store.close()


def test_only_changes_are_written(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    store.remember(PEERS)
    store = reopen(store, tmp_path)
    before = (tmp_path / LAST_GOOD_FILE).stat()
    store.remember(PEERS)
    store.close()
    after = (tmp_path / LAST_GOOD_FILE).stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_files_are_for_the_owner_only(tmp_path: Path) -> None:
    store = StateStore(tmp_path / "state", OWNER)
    store.remember(PEERS)
    store.close()
    for path in (tmp_path / "state").iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o700


def test_a_second_sidecar_is_kept_out_until_the_first_is_gone(tmp_path: Path) -> None:
    store = StateStore(tmp_path, OWNER)
    with pytest.raises(StateDirError, match="another sidecar"):
        StateStore(tmp_path, OWNER)
    store.close()
    StateStore(tmp_path, OWNER).close()


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StateDirError, match="a writable folder"):
        StateStore(tmp_path / "file" / "state", OWNER)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: data[:20],
        lambda data: data[:-1],
        lambda data: data + b"\0",
        lambda data: b"X" + data[1:],
        lambda data: data[:8] + b"\0\7" + data[10:],
        lambda data: data[:-3] + bytes([data[-3] ^ 1]) + data[-2:],
        lambda data: data[:20] + bytes([data[20] ^ 1]) + data[21:],
        lambda data: bytes(len(data)),
    ],
)
@pytest.mark.parametrize("name", [IDENTITY_FILE, LAST_GOOD_FILE])
def test_a_spoilt_file_is_set_aside_and_counted_and_the_sidecar_starts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, spoil: Callable[[bytes], bytes]
) -> None:
    store = StateStore(tmp_path, OWNER)
    store.remember(PEERS)
    store.close()
    path = tmp_path / name
    spoilt = spoil(path.read_bytes())
    path.write_bytes(spoilt)
    store = StateStore(tmp_path, OWNER)
    store.close()
    assert dict(store.failures) == {f"{name.replace('-', '_')}_refused": 1}
    assert f"{path} is refused" in caplog.text
    assert (tmp_path / f"{name}.refused").read_bytes() == spoilt
    assert (store.last_good == LastGood(OWNER)) == (name == LAST_GOOD_FILE)
    assert len(store.identity.token) == 16


def test_what_an_earlier_format_holds_is_set_aside_and_the_identity_stays(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = StateStore(tmp_path, OWNER)
    store.remember(PEERS)
    store.close()
    path = tmp_path / LAST_GOOD_FILE
    data = path.read_bytes()
    path.write_bytes(data[:8] + (1).to_bytes(2, "big") + data[10:])
    token = store.identity.token
    store = StateStore(tmp_path, OWNER)
    assert store.last_good == LastGood(OWNER)
    assert store.identity.token == token
    assert dict(store.failures) == {"last_good_refused": 1}
    assert "format version 1, not 2" in caplog.text
    store.close()


def test_another_sidecars_state_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = StateStore(tmp_path, NodeName("robot-2"))
    store.remember(PEERS)
    store.close()
    store = StateStore(tmp_path, OWNER)
    assert store.last_good == LastGood(OWNER)
    assert "robot-2" in caplog.text
    store.close()


def test_a_failing_write_is_counted_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = StateStore(tmp_path, OWNER)
    (tmp_path / f"{LAST_GOOD_FILE}.new").mkdir()
    store.remember(PEERS)
    store.close()
    assert set(store.failures) == {"write_failed"}
    assert "the sidecar tries again, and a restart before that loses it" in caplog.text


@pytest.mark.audit("ops-10")
def test_what_did_not_fit_on_a_full_disk_is_written_when_there_is_room(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_store, "RETRY_S", 0.01)
    full = True
    real = own_folder.write_through

    def write_through(file: IO[bytes], data: bytes) -> None:
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(file, data)

    monkeypatch.setattr(own_folder, "write_through", write_through)
    store = StateStore(tmp_path, NodeName("robot-1"))
    store.remember_revocations(b"an older list")
    store.remember_clock_floor(1e9)
    end = time.monotonic() + 30.0
    while store.failures["write_failed"] < 12:
        assert time.monotonic() < end
        time.sleep(0.01)
    store.remember_revocations(b"a list")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lock"]
    full = False
    token = store.identity.token
    store.close()
    assert len([record for record in caplog.records if record.levelname == "ERROR"]) == 3
    again = StateStore(tmp_path, NodeName("robot-1"))
    assert (again.revocations, again.clock_floor, again.identity.token) == (b"a list", 1e9, token)
    again.close()


WRITE_FOR_EVER = """
import itertools, sys
from pathlib import Path
import plr.sidecar.state.store as state_store
from plr.protos.model.ids import NodeName, Version
from plr.protos.model.mapping import MappingSet
state_store.MIN_WRITE_INTERVAL_S = 0.0
store = state_store.StateStore(Path(sys.argv[1]), NodeName("robot-1"))
busy = False
for version in itertools.count(1):
    store.remember(MappingSet(Version(version), 0))
    if not busy and version >= 100 and Path(sys.argv[1], state_store.LAST_GOOD_FILE).exists():
        busy = True
        sys.stdout.write("busy\\n")
        sys.stdout.flush()
"""


def test_a_kill_in_the_middle_of_writing_leaves_a_whole_file(tmp_path: Path) -> None:
    versions = []
    for attempt in range(4):
        argv = [sys.executable, "-c", WRITE_FOR_EVER, str(tmp_path)]
        root = Path(__file__).parents[4]
        with subprocess.Popen(argv, stdout=subprocess.PIPE, cwd=root) as process:
            assert process.stdout
            assert process.stdout.readline() == b"busy\n"
            time.sleep(0.03 * attempt)
            process.send_signal(signal.SIGKILL)
        store = StateStore(tmp_path, OWNER)
        assert not store.failures
        if store.last_good.mapping is not None:
            versions.append(store.last_good.mapping.version)
        store.close()
    assert versions


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting takes root")
def test_a_card_gone_read_only_still_yields_the_last_mapping(tmp_path: Path) -> None:
    script = f"""
    set -e
    mount -t tmpfs none {tmp_path}
    cd {Path(__file__).parents[4]}
    {sys.executable} -c '{OPEN_AND_REMEMBER}' {tmp_path} 5
    mount -o remount,ro {tmp_path}
    {sys.executable} -c '{OPEN_AND_REMEMBER}' {tmp_path} 6
    """
    done = subprocess.run(["unshare", "--mount", "bash", "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["None", "5"]
    assert "Read-only file system" in done.stderr


@pytest.mark.audit("ops-5")
@pytest.mark.skipif(os.geteuid() != 0, reason="mounting takes root")
def test_a_card_that_was_read_only_from_the_beginning_keeps_no_sidecar_from_running(tmp_path: Path) -> None:
    script = f"""
    set -e
    mount -t tmpfs -o ro none {tmp_path}
    cd {Path(__file__).parents[4]}
    {sys.executable} -c '{OPEN_AND_REMEMBER}' {tmp_path} 5
    """
    done = subprocess.run(["unshare", "--mount", "bash", "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["None"]
    assert "Read-only file system" in done.stderr


OPEN_AND_REMEMBER = """
import sys
from pathlib import Path
from plr.protos.model.ids import NodeName, Version
from plr.protos.model.mapping import MappingSet
from plr.sidecar.state.store import StateStore
store = StateStore(Path(sys.argv[1]), NodeName("robot-1"))
sys.stdout.write(str(store.last_good.mapping and store.last_good.mapping.version) + " ")
store.remember(MappingSet(Version(int(sys.argv[2])), 0))
store.close()
"""


def test_contents_come_back_from_their_encoding() -> None:
    assert decode_last_good(encode_last_good(EVERYTHING), OWNER) == EVERYTHING
    identity = SavedIdentity(bytes(range(16)), (1 << 64) - 1)
    assert decode_identity(encode_identity(identity)) == identity
    known = ControlAddresses(("cp.example:50051",), (("192.0.2.1", 50051), ("::1", 1)))
    assert decode_addresses(encode_addresses(known)) == known


def test_one_file_is_not_taken_for_the_other() -> None:
    with pytest.raises(DecodeError, match="not a file of this kind"):
        decode_identity(encode_last_good(EVERYTHING))
    with pytest.raises(DecodeError, match="not a file of this kind"):
        decode_last_good(encode_identity(SavedIdentity(bytes(16), 1)), OWNER)
    with pytest.raises(DecodeError, match="not a file of this kind"):
        decode_addresses(encode_identity(SavedIdentity(bytes(16), 1)))
