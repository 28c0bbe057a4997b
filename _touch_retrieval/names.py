"""Names of files and objects as people and other systems write them."""

import unicodedata

SYSTEM_NAMES = frozenset(
    {"#recycle", "#snapshot", "$recycle.bin", "@eadir", "@recently-snapshot", "@recycle", "@tmp", "__macosx"}
    | {"desktop.ini", "ehthumbs.db", "found.000", "icon\r", "lost+found", "network trash folder"}
    | {"system volume information", "temporary items", "thumbs.db", "__pycache__"}
)
"""Names of what Windows, macOS and network drives leave in folders, in lower case."""


def is_system_name(name: str) -> bool:
    """Whether a file or folder is hidden (its name starts with a dot), or is left by a system or an open document."""
    return name.startswith((".", "~$", "@Syno")) or name.casefold() in SYSTEM_NAMES or name.endswith("@SynoEAStream")


def lookup_key(name: str) -> str:
    """Return the text by which a name is looked up: in the Unicode form NFC, without spaces around it.

    macOS writes file names in another form (NFD) than keyboards and spreadsheets do.
    """
    return unicodedata.normalize("NFC", name).strip()


def same_object_key(name: str) -> str:
    """Return a text that is equal for names that differ only by case, spaces or Unicode form."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())
