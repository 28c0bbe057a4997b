"""Processes of a Ray that a test has started: which there are, and on which addresses they listen."""

import os
import re
from pathlib import Path


def parents():
    """{process: its parent}, of all of this machine that have not ended."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            after = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if after[0] != "Z":  # nobody has taken note of its end
            found[int(path.parent.name)] = int(after[1])
    return found


def descendants(root=None):
    """Processes below `root`, which is this one where None."""
    parent_of, root = parents(), root or os.getpid()

    def below(process):
        while process in parent_of:
            process = parent_of[process]
            if process == root:
                return True
        return False

    return [process for process in parent_of if below(process)]


def processes_named(pattern, root=None):
    """Those of them whose name, as Ray writes it, matches."""
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
    """Addresses, in hexadecimal, on which they listen."""
    mine = set()
    for process in [*descendants(root), root or os.getpid()]:
        try:
            mine |= {os.readlink(link) for link in Path(f"/proc/{process}/fd").iterdir()}
        except OSError:
            continue
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in mine:
                found.add(words[1].partition(":")[0])
    return found
