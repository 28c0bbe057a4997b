"""Entry points for a registry from a folder on `sys.path`, without an installed package."""


def install(folder, monkeypatch, **groups):
    """Register entry points of a package in `folder`: groups={"towers": {"mine": "module:Class"}}."""
    metadata = folder / "mine-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    lines = []
    for kind, names in groups.items():
        lines += [f"[touch_retrieval.{kind}]", *(f"{name} = {target}" for name, target in names.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(folder)
