"""Whatever happens while a file is written, there is the old one or the new one."""

import errno
import multiprocessing
import os
import stat
import time
import zipfile

import pytest

import sb3_belief.common.durable_files as durable_files
from sb3_belief.common.durable_files import make_folder, process_lives, replaced_file, sweep_temporary_files, sync_folder
from tests.common.crashes import check_old_or_new, recorded


def write_zip(path):
    with replaced_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(4):
            archive.writestr(f"part-{i}", os.urandom(5_000))


@pytest.mark.parametrize("old", [None, b"old"])
def test_a_crash_at_any_moment_leaves_the_old_or_the_new_file(tmp_path, monkeypatch, old):
    path = tmp_path / "team.zip"
    if old is not None:
        path.write_bytes(old)
    with recorded(tmp_path, monkeypatch) as disk:
        write_zip(path)
    assert len(disk.steps) > 6
    check_old_or_new(disk, "team.zip", old, path.read_bytes())


@pytest.mark.parametrize("forgotten", ["file", "folder"])
def test_without_one_of_the_syncs_a_crash_is_seen_to_do_harm(tmp_path, monkeypatch, forgotten):
    path = tmp_path / "team.zip"
    path.write_bytes(b"old")
    with recorded(tmp_path, monkeypatch) as disk:
        write_zip(path)
    disk.steps = [step for step in disk.steps if step[0] != f"sync {forgotten}"]
    with pytest.raises(AssertionError):
        check_old_or_new(disk, "team.zip", b"old", path.read_bytes())


def test_text_is_encoded_as_said(tmp_path):
    with replaced_file(tmp_path / "a.txt", "w", encoding="utf-16-le", newline="\r\n") as file:
        file.write("ä\n")
    assert (tmp_path / "a.txt").read_bytes() == "ä\r\n".encode("utf-16-le")


def test_another_mode_is_refused(tmp_path):
    with pytest.raises(ValueError, match="'w', 'w\\+' or 'wb', not 'ab'"), replaced_file(tmp_path / "a", "ab"):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("where", ["write", "fsync", "replace"])
def test_after_an_error_the_old_file_is_there_and_no_other(tmp_path, monkeypatch, error, where):
    (tmp_path / "a").write_bytes(b"old")

    def fail(*_):
        raise error

    if where != "write":
        monkeypatch.setattr(os, where, fail)
    with pytest.raises(type(error)), replaced_file(tmp_path / "a") as file:
        file.write(b"new")
        if where == "write":
            fail()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"old"}


def test_the_old_file_is_read_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with replaced_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_permissions_are_those_of_any_new_file(tmp_path, umask):
    before = os.umask(umask)
    try:
        with replaced_file(tmp_path / "a"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o666 & ~umask


def test_the_longest_name_is_written(tmp_path):
    path = tmp_path / ("n" * 255)
    with replaced_file(path) as file:
        file.write(b"1")
    assert path.read_bytes() == b"1"


def dead_pid():
    process = multiprocessing.get_context("spawn").Process(target=int)
    process.start()
    process.join()
    return process.pid


@pytest.mark.skipif(os.name == "nt", reason="processes cannot be asked for")
def test_files_of_dead_processes_are_swept_and_no_others(tmp_path):
    dead, living = dead_pid(), os.getppid()
    names = {
        f".team.zip.{dead}-0123abcd.tmp": False,
        # This process does not write it, so one of the same number did in another container
        f".team.zip.{os.getpid()}-0123abcd.tmp": False,
        f".team.zip.{living}-0123abcd.tmp": True,
        f".team.zip.{living}-4567abcd.tmp": False,
        f"team.zip.{dead}-0123abcd.tmp": True,
        f".team.zip.{dead}.tmp": True,
        "team.zip": True,
    }
    for name in names:
        (tmp_path / name).touch()
    os.utime(tmp_path / f".team.zip.{living}-4567abcd.tmp", (time.time() - 90_000,) * 2)
    with replaced_file(tmp_path / "new") as file:
        file.write(b"1")
        removed = sweep_temporary_files(tmp_path)
    assert {path.name for path in removed} == {name for name, stays in names.items() if not stays}
    assert {path.name for path in tmp_path.iterdir()} == {name for name, stays in names.items() if stays} | {"new"}
    assert (tmp_path / "new").read_bytes() == b"1"


@pytest.mark.skipif(os.name == "nt", reason="processes cannot be asked for")
def test_living_and_dead_processes_are_told_apart():
    assert process_lives(os.getpid()) and process_lives(1)
    assert not process_lives(dead_pid()) and not process_lives(10**30)


def test_new_folders_are_synced_in_those_above(tmp_path, monkeypatch):
    synced: list = []
    monkeypatch.setattr(durable_files, "sync_folder", synced.append)
    assert make_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert synced == [tmp_path, tmp_path / "a"]
    assert (tmp_path / "a" / "b").is_dir()
    make_folder(tmp_path / "a" / "b")
    assert len(synced) == 2


@pytest.mark.skipif(os.name == "nt", reason="folders cannot be synced")
def test_a_file_system_that_cannot_sync_folders_is_not_an_error_and_a_broken_disk_is(tmp_path, monkeypatch):
    def fail(number):
        def fsync(_):
            raise OSError(number, os.strerror(number))

        return fsync

    monkeypatch.setattr(os, "fsync", fail(errno.EINVAL))
    sync_folder(tmp_path)
    monkeypatch.setattr(os, "fsync", fail(errno.EIO))
    with pytest.raises(OSError, match="Input/output"):
        sync_folder(tmp_path)
