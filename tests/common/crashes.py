"""What may be left on a disk if the machine crashes while files are written."""

import io
import itertools
import os
from contextlib import contextmanager

import sb3_belief.common.durable_files as durable_files


class Disk:
    """
    Records what is written below a folder, and says what a crash may leave of it.

    A crash keeps what was synced. Of the rest the system may have written any beginning of the changes to a folder, and any
    beginning, any end or nothing of the changes to a file's content, in any order of the two.
    """

    def __init__(self, folder):
        self.folder = os.fspath(folder)
        self.first = {name: self._read(name) for name in os.listdir(folder)}
        self.steps = []

    def _read(self, name):
        with open(os.path.join(self.folder, name), "rb") as file:
            return file.read()

    def after_crashes(self, n_steps):
        """Yield each {name: content} that a crash after that many steps may leave."""
        steps = self.steps[:n_steps]
        changes = [step for step in steps if step[0] in ("create", "rename", "unlink")]
        synced = max((i for i, step in enumerate(steps) if step[0] == "sync folder"), default=-1)
        certain = sum(step[0] in ("create", "rename", "unlink") for step in steps[: synced + 1])
        nodes = [step[2] for step in steps if step[0] == "create"]
        for n_changes in range(certain, len(changes) + 1):
            for contents in itertools.product(*(self._contents(steps, node) for node in nodes)):
                files = dict(self.first)
                names = {}
                for kind, name, *more in changes[:n_changes]:
                    if kind == "create":
                        names[name] = contents[nodes.index(more[0])]
                    elif kind == "rename":
                        files[more[0]] = names.pop(name)
                    else:
                        (names if name in names else files).pop(name)
                yield files | names

    def _contents(self, steps, node):
        """Return what a crash may leave of a file's content."""
        synced = max((i for i, step in enumerate(steps) if step == ("sync file", node)), default=-1)
        writes = [(i, *step[2:]) for i, step in enumerate(steps) if step[:2] == ("write", node)]
        sure, open_ = [w for w in writes if w[0] <= synced], [w for w in writes if w[0] > synced]
        kept = {(0, len(open_))} | {(0, k) for k in range(len(open_))} | {(k, len(open_)) for k in range(len(open_))}
        found = set()
        for first, last in kept:
            content = bytearray()
            for _, offset, data in sure + open_[first:last]:
                content.extend(bytes(max(0, offset + len(data) - len(content))))
                content[offset : offset + len(data)] = data
            found.add(bytes(content))
        return sorted(found)


@contextmanager
def recorded(folder, monkeypatch):
    """Record what ``durable_files`` does in a folder while the context lasts."""
    disk, nodes, folders = Disk(folder), {}, set()
    real_open, real_fsync, real_replace, real_unlink = os.open, os.fsync, os.replace, os.unlink

    def inside(path):
        return os.path.dirname(os.path.abspath(path)) == os.path.abspath(disk.folder)

    def os_open(path, flags, mode=0o777, **kwargs):
        descriptor = real_open(path, flags, mode, **kwargs)
        if os.path.abspath(path) == os.path.abspath(disk.folder):
            folders.add(descriptor)
        elif inside(path) and flags & os.O_CREAT:
            folders.discard(descriptor)
            nodes[descriptor] = len(disk.steps)
            disk.steps.append(("create", os.path.basename(path), nodes[descriptor]))
        return descriptor

    def fsync(descriptor):
        real_fsync(descriptor)
        if descriptor in folders:
            disk.steps.append(("sync folder",))
        elif descriptor in nodes:
            disk.steps.append(("sync file", nodes[descriptor]))

    def replace(source, target):
        real_replace(source, target)
        if inside(target):
            disk.steps.append(("rename", os.path.basename(source), os.path.basename(target)))

    def unlink(path, **kwargs):
        real_unlink(path, **kwargs)
        if inside(path):
            disk.steps.append(("unlink", os.path.basename(path)))

    class Raw(io.FileIO):
        def write(self, data):
            offset = self.tell()
            written = super().write(data)
            disk.steps.append(("write", nodes[self.fileno()], offset, bytes(data)[:written]))
            return written

    def open_(path, mode, opener=None, **kwargs):
        raw = Raw(path, mode.replace("b", ""), opener=opener)
        file = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return file if "b" in mode else io.TextIOWrapper(file, **kwargs)

    with monkeypatch.context() as patched:
        patched.setattr(os, "open", os_open)
        patched.setattr(os, "fsync", fsync)
        patched.setattr(os, "replace", replace)
        patched.setattr(os, "unlink", unlink)
        patched.setattr(durable_files, "open", open_, raising=False)
        yield disk


def check_old_or_new(disk, name, old, new):
    """Check that whatever moment a crash comes at, a file is the old or the new one, and the new one after the last step."""
    seen = set()
    for n_steps in range(len(disk.steps) + 1):
        for files in disk.after_crashes(n_steps):
            assert files.get(name) in (old, new), f"after {n_steps} of {[step[:2] for step in disk.steps]}"
            seen.add(files.get(name))
    assert seen == {old, new}
    assert {files[name] for files in disk.after_crashes(len(disk.steps))} == {new}
