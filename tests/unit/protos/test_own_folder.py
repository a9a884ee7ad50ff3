"""In a state folder that somebody else made first, no file of his choice is made or changed."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from controlplane.event_log import EventLog
from protos.fleet_events import EventKind
from protos.model import NodeName
from protos.own_folder import OwnFolder
from sidecar.state_store import StateDirError, StateStore

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

NOBODY = 65534
OTHERS = pytest.mark.skipif(os.geteuid() != 0, reason="giving a folder away takes root")


@OTHERS
def test_a_folder_of_another_user_is_refused_by_both_programs_in_one_line(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    (state / "lock").symlink_to(tmp_path / "nologin")
    os.chown(state, NOBODY, NOBODY)
    with pytest.raises(StateDirError, match=f"state belongs to user {NOBODY}: chown it"):
        StateStore(state, NodeName("robot"))
    log = EventLog(state)
    assert f"state belongs to user {NOBODY}: chown it" in log.state.problem
    log.close()
    assert [one.name for one in state.iterdir()] == ["lock"]
    assert not (tmp_path / "nologin").exists()


@OTHERS
def test_a_link_in_place_of_the_folder_is_followed_if_we_made_it(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    folder = OwnFolder(tmp_path / "link")
    folder.write("file", b"content")
    folder.close()
    assert (tmp_path / "real" / "file").read_bytes() == b"content"
    os.chown(tmp_path / "link", NOBODY, NOBODY, follow_symlinks=False)
    with pytest.raises(OSError, match=f"link is a link of user {NOBODY}"):
        OwnFolder(tmp_path / "link")


@OTHERS
def test_a_file_that_another_user_added_is_not_read(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    (tmp_path / "file").write_text("forged")
    os.chown(tmp_path / "file", NOBODY, NOBODY)
    folder = OwnFolder(tmp_path)
    with pytest.raises(OSError, match=f"file belongs to user {NOBODY}"):
        folder.open_to_read("file")
    folder.close()


def test_a_folder_that_everybody_may_change_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state").chmod(0o777)
    with pytest.raises(StateDirError, match="everybody may change"):
        StateStore(tmp_path / "state", NodeName("robot"))


def test_links_in_the_folder_lead_nowhere(tmp_path: Path) -> None:
    state, victim = tmp_path / "state", tmp_path / "victim"
    state.mkdir()
    victim.write_text("precious")
    for name in ("identity", "identity.new", "events.jsonl", "events.jsonl.new"):
        (state / name).symlink_to(victim)
    (state / "events.jsonl").unlink()
    StateStore(state, NodeName("robot")).close()
    log = EventLog(state)
    log.record(EventKind.STARTED)
    log.close()
    assert victim.read_text() == "precious"
    assert not (state / "identity").is_symlink()
    (state / "lock").unlink()
    (state / "lock").symlink_to(tmp_path / "nologin")
    with pytest.raises(StateDirError, match="lock is a link: remove it"):
        StateStore(state, NodeName("robot"))
    log = EventLog(state)
    assert "lock is a link: remove it" in log.state.problem
    log.close()
    assert not (tmp_path / "nologin").exists()


def test_a_folder_moved_away_is_still_the_one_written_to(tmp_path: Path) -> None:
    folder = OwnFolder(tmp_path / "state")
    (tmp_path / "state").rename(tmp_path / "moved")
    (tmp_path / "state").symlink_to(tmp_path / "elsewhere")
    folder.write("file", b"content")
    folder.close()
    assert (tmp_path / "moved" / "file").read_bytes() == b"content"


def test_files_are_for_this_user_alone_also_those_of_an_earlier_version(tmp_path: Path) -> None:
    (tmp_path / "lock").touch(0o644)
    log = EventLog(tmp_path)
    log.record(EventKind.STARTED)
    log.close()
    assert {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {
        "lock": 0o600,
        "events.jsonl": 0o600,
    }
