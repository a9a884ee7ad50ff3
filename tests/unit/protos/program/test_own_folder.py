"""In a state folder that somebody else made first, no file of his choice is made or changed."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.observe.event_log import EventLog
from plr.protos.model.fleet_events import EventKind
from plr.protos.model.ids import NodeName
from plr.protos.program.own_folder import OwnFolder
from plr.sidecar.state.store import StateDirError, StateStore

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
def test_a_link_or_folder_above_it_is_judged_as_it_is(tmp_path: Path) -> None:
    """With a link of somebody else's above it, root would make and write the folder where that leads."""
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "link").symlink_to("victim")
    folder = OwnFolder(tmp_path / "link" / "more" / "state")
    folder.write("file", b"content")
    folder.close()
    assert (victim / "more" / "state" / "file").read_bytes() == b"content", "root's own, as /var/run is"
    assert (victim / "more" / "state").stat().st_mode & 0o777 == 0o700
    os.chown(tmp_path / "link", NOBODY, NOBODY, follow_symlinks=False)
    with pytest.raises(StateDirError, match=f"link is a link of user {NOBODY}"):
        StateStore(tmp_path / "link" / "other" / "state", NodeName("robot"))
    assert not (victim / "other").exists()
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    os.chown(theirs, NOBODY, NOBODY)
    log = EventLog(theirs / "state")
    assert f"theirs belongs to user {NOBODY}: chown it" in log.state.problem
    log.close()
    assert not (theirs / "state").exists()


def test_what_everybody_may_change_above_it_is_refused_but_not_one_such_as_tmp(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(OSError, match="everybody may change"):
        OwnFolder(tmp_path / "open" / "state")
    (tmp_path / "open").chmod(0o1777)
    OwnFolder(tmp_path / "open" / "state").close()


def test_links_lead_on_from_where_they_stand_and_not_in_a_circle(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "up").symlink_to("../c")
    (tmp_path / "whole").symlink_to(tmp_path / "a" / "up")
    OwnFolder(tmp_path / "whole" / ".." / "a" / "b" / "state").close()
    assert (tmp_path / "a" / "b" / "state").is_dir()
    assert (tmp_path / "c").is_dir()
    (tmp_path / "round").symlink_to("round")
    with pytest.raises(OSError, match="Too many levels"):
        OwnFolder(tmp_path / "round" / "state")
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        OwnFolder(tmp_path / "file" / "state")


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
