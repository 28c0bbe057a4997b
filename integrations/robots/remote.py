"""A robot that a program on another computer moves, called over HTTP, for `driver = "own"`.

Each call is a POST request to `url`/method with its values as a JSON object. The program answers with status 200 and
JSON, or with an error status and a text, which becomes the error message. There is no encryption and no password: use
a network of your own.
"""

import json
import urllib.error
import urllib.request

MOTION_S, ANSWER_S = 60.0, 5.0
"""Longest wait for the end of a motion, and for an answer without one."""


class RemoteRobot:
    """An arm or a gripper at `url`, such as http://192.168.1.20:8000/arm."""

    def __init__(self, url):
        self.url = url
        self.opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # without the environment's proxies

    def _call(self, method, **values):
        head = {"Content-Type": "application/json"}
        request = urllib.request.Request(f"{self.url}/{method}", json.dumps(values).encode(), head, method="POST")
        try:
            with self.opener.open(request, timeout=MOTION_S if values else ANSWER_S) as answer:
                content = answer.read()
        except urllib.error.HTTPError as error:
            raise RuntimeError(f"{self.url}/{method} answered {error.code}: {error.read(500).decode()}") from error
        return json.loads(content) if content else None

    def __getattr__(self, method):
        if method not in ("move_to", "pose", "open", "grasp", "state", "stop"):
            raise AttributeError(method)
        return lambda **values: self._call(method, **values)
