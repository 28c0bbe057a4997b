"""A real browser on the page: Debian's Chromium, driven by playwright, and the service in this process."""

import shutil
import signal
import threading
from contextlib import contextmanager

import pytest
import uvicorn
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Error, sync_playwright

from retrieval.serve.app import create_app
from retrieval.serve.server import Server
from retrieval.serve.settings import ServiceSettings
from tests.waiting import wait_until

NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
CAMERA = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
"""Chromium's camera that shows a turning disc, and a yes to whoever asks for it."""
LIMIT_MS = 60_000
"""Of one wait, on a busy machine."""


@contextmanager
def chromium():
    """The browser. The test is skipped where none is installed."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on PATH (apt-get install chromium)")
    with sync_playwright() as driver:
        try:
            # Its sandbox wants rights that containers do not give; it shows our own page only.
            opened = driver.chromium.launch(executable_path=path, args=[*CAMERA, "--no-sandbox"])
        except Error as error:
            pytest.skip(f"{path} does not start: {str(error).splitlines()[0]}")
        yield opened
        opened.close()


@contextmanager
def address(index, *beside, **settings):
    """Where the service of an index listens, on a port of its own."""
    app = create_app(ServiceSettings(index=index, **settings), *beside)
    ports = []
    config = uvicorn.Config(app, port=0, log_level="warning", access_log=False, ws="none", timeout_graceful_shutdown=2)
    server = Server(config, app.state.service, ports.append)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        wait_until(lambda: ports or not thread.is_alive(), 120.0)
        yield f"http://127.0.0.1:{ports[0]}/"
    finally:
        server.handle_exit(signal.SIGTERM, None)
        thread.join(60)


@contextmanager
def page(browser, url, width=1280, **context):
    """A page of its own, which must say nothing wrong on the browser's console and throw nothing."""
    with browser.new_context(viewport={"width": width, "height": 844}, **context) as own:
        opened = own.new_page()
        opened.set_default_timeout(LIMIT_MS)
        said = []
        opened.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        opened.on("pageerror", lambda error: said.append(str(error)))
        opened.goto(url)
        opened.locator("h1, dialog").first.wait_for()
        yield opened
        # What the service refuses, Chromium writes on the console too; the tests read what the page says of it.
        assert [text for text in said if not text.startswith("Failed to load resource")] == []


def serious(opened):
    """What axe-core finds that is serious or critical, as lines."""
    found = Axe().run(opened).response["violations"]
    return [
        f"{one['id']}: {one['help']}: {node['html'][:200]}"
        for one in found
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]


def choose(opened, button, files):
    """Choose files as with the mouse."""
    with opened.expect_file_chooser() as chooser:
        opened.get_by_role("button", name=button).click()
    chooser.value.set_files([str(path) for path in files])


def ask(opened, files):
    """Choose gel images, ask, and wait for the answer."""
    choose(opened, "Choose gel images", files)
    opened.get_by_role("button", name="Ask", exact=True).click()
    opened.locator(".answer").wait_for()
