"""Shared fixtures of the service's tests."""

import base64

import pytest

from tests.serving import service


@pytest.fixture(scope="module")
def client(index):
    """A client of a service in this process."""
    with service(index) as client:
        yield client


@pytest.fixture(scope="module")
def body(touch):
    """A query of one grasp, as JSON."""
    return {"touches": [[base64.b64encode(path.read_bytes()).decode() for path in touch]]}


@pytest.fixture(scope="module")
def browser():
    """Chromium; the test is skipped if none is installed."""
    from tests.browser import chromium

    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def files(two_grasps, tmp_path_factory):
    """The gel images of two grasps of one object, with typical file names."""
    folder = tmp_path_factory.mktemp("gels")
    names = [folder / f"{grasp}_{finger}.png" for grasp in ("first", "second") for finger in "ab"]
    for name, source in zip(names, [*two_grasps[0], *two_grasps[1]], strict=True):
        name.write_bytes(source.read_bytes())
    return names
