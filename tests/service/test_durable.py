import errno
import os
import stat
from contextlib import nullcontext
from pathlib import Path

import pytest

from service.durable import locked, write_durably
from tests.full_disk import files_of_at_most


def test_a_power_cut_leaves_the_old_file_or_the_new_one_and_takes_neither_back(tmp_path, monkeypatch):
    """Its bytes are on the disk before it takes the old one's place, and that it did once the folder is."""
    path, on_disk, really = tmp_path / "kept", [], os.fsync
    write_durably(path, b"old")

    def fsync(number):
        really(number)
        synced = Path(f"/proc/self/fd/{number}").resolve()
        on_disk.append((synced if synced.is_dir() else synced.read_text(), path.read_text()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_durably(path, "the new one")
    assert on_disk == [("the new one", "old"), (tmp_path.resolve(), "the new one")]


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "kept"
    write_durably(path, b"old")
    with pytest.raises(TypeError):
        write_durably(path, 1)
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (b"old", [path])


def test_a_full_disk_is_named_and_keeps_no_part_of_a_file(tmp_path):
    with files_of_at_most(20_000), pytest.raises(OSError, match=r"too large: '.*kept'"):
        write_durably(tmp_path / "kept", bytes(30_000))
    with pytest.raises(IsADirectoryError, match=tmp_path.name):
        write_durably(tmp_path, b"new")
    assert not list(tmp_path.parent.glob(".*.tmp")) + list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_only_a_share_that_syncs_no_folder_is_written_without(tmp_path, monkeypatch, number):
    really = os.fsync

    def fsync(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        really(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with nullcontext() if number == errno.EINVAL else pytest.raises(OSError, match=r"error: '.*kept'"):
        write_durably(tmp_path / "kept", "new")
    assert (tmp_path / "kept").read_text() == "new"


def test_a_lock_has_one_holder_until_it_is_closed(tmp_path):
    with locked(tmp_path), pytest.raises(BlockingIOError):
        locked(tmp_path)
    locked(tmp_path).close()
