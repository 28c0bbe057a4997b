"""Processes of a Ray cluster that a test started, and their listening addresses."""

import os
import re
from pathlib import Path


def parents():
    """Return {process: parent} of all running processes of this machine."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if fields[0] != "Z":  # a zombie has ended
            found[int(path.parent.name)] = int(fields[1])
    return found


def descendants(root=None):
    """Return all descendants of process `root`; None for this process."""
    parent_of, root = parents(), root or os.getpid()

    def is_below(process):
        while process in parent_of:
            process = parent_of[process]
            if process == root:
                return True
        return False

    return [process for process in parent_of if is_below(process)]


def processes_named(pattern, root=None):
    """Return the descendants whose name, as set by Ray, matches."""
    found = []
    for process in descendants(root):
        try:
            name = Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")
        except OSError:
            continue
        if re.match(pattern, name):
            found.append(process)
    return found


def listening_addresses(root=None):
    """Return the listening addresses of a process and its descendants, in hexadecimal."""
    sockets = set()
    for process in [*descendants(root), root or os.getpid()]:
        try:
            sockets |= {os.readlink(link) for link in Path(f"/proc/{process}/fd").iterdir()}
        except OSError:
            continue
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in sockets:
                found.add(words[1].partition(":")[0])
    return found
