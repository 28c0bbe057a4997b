"""What an installed package adds to a registry, without installing one: the entry points of a folder on `sys.path`."""


def install(folder, monkeypatch, **groups):
    """Have a package in `folder` name things: groups={"towers": {"mine": "module:Class"}}."""
    about = folder / "mine-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    lines = []
    for kind, names in groups.items():
        lines += [f"[touch_retrieval.{kind}]", *(f"{name} = {place}" for name, place in names.items())]
    (about / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(folder)
