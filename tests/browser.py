"""A real browser for the page: Debian's Chromium, driven by playwright, with the service in this process."""

import shutil
from contextlib import contextmanager

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Error, sync_playwright

from tests.serving import listening

NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
CAMERA = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
"""Chromium's fake camera, which shows a turning disc, and permission to use it."""
LIMIT_MS = 60_000
"""Time limit of one wait, on a busy machine."""


@contextmanager
def chromium():
    """Yield the browser; skip the test if none is installed."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on PATH (apt-get install chromium)")
    with sync_playwright() as driver:
        try:
            # The sandbox needs rights that containers lack; the browser shows only our own page.
            opened = driver.chromium.launch(executable_path=path, args=[*CAMERA, "--no-sandbox"])
        except Error as error:
            pytest.skip(f"{path} does not start: {str(error).splitlines()[0]}")
        yield opened
        opened.close()


@contextmanager
def address(index, *parts, **settings):
    """Serve an index on a free port; yield the address. parts: further arguments of `create_app`."""
    with listening(index, *parts, **settings) as (url, _):
        yield f"{url}/"


@contextmanager
def page(browser, url, width=1280, **context):
    """Yield a new page, which must print no errors on the browser's console."""
    with browser.new_context(viewport={"width": width, "height": 844}, **context) as own:
        opened = own.new_page()
        opened.set_default_timeout(LIMIT_MS)
        errors = []
        opened.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.goto(url)
        opened.locator("h1, dialog").first.wait_for()
        yield opened
        # Chromium also prints refused requests on the console; the tests check the page's own message.
        assert [text for text in errors if not text.startswith("Failed to load resource")] == []


def serious(opened):
    """Return the serious and critical findings of axe-core, as lines."""
    found = Axe().run(opened).response["violations"]
    return [
        f"{one['id']}: {one['help']}: {node['html'][:200]}"
        for one in found
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]


def choose(opened, button, files):
    """Choose files with a button of the page."""
    with opened.expect_file_chooser() as chooser:
        opened.get_by_role("button", name=button).click()
    chooser.value.set_files([str(path) for path in files])


def ask(opened, files):
    """Choose gel images, press Ask, and wait for the answer."""
    choose(opened, "Choose gel images", files)
    opened.get_by_role("button", name="Ask", exact=True).click()
    opened.locator(".answer").wait_for()
