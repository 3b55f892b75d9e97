"""A worker process that answers, counts, prints, fails or dies, as its request requires."""

from __future__ import annotations

import os
import signal

from sgstore.base.processes import requests, send_reply


def main() -> None:
    for request in requests():
        print("printed text")
        os.write(1, b"\r  8% printed by a library")
        if request["do"] == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if request["do"] == "fail":
            raise ValueError("a fault of the worker")
        for number in range(request.get("parts", 0)):
            send_reply({"more": True, "part": number})
        send_reply({"echo": request["do"]})
