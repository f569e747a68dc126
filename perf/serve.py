"""Load the HTTP server on loopback: many clients for a while, every answer accounted for, memory watched.

    python perf/serve.py                                   16 clients, 60 seconds, scripted models of 10 ms a call
    python perf/serve.py --profile offline --seconds 30    real work
    python perf/serve.py --requests 10000                  pictures of many sizes; memory at every thousandth request
    python perf/serve.py --json                            the figures for a script

Exit code 1 if an answer was lost, was neither what the request deserves nor a 503 with Retry-After, if the server
counted other answers than the clients, or if its memory grew by more than a tenth after the first third of the time
(with --requests: if it left the first thousandth's by more than 5 %).
"""

from __future__ import annotations

import argparse
import base64
import http.client
import io
import json
import re
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from PIL import Image

PATH = "/v1/affordances"


@dataclass
class Tally:
    """What one client saw."""

    sent: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


SIZES = ((64, 48), (320, 240), (640, 480), (1280, 960), (2000, 1500))


def photo(size: tuple[int, int] = (640, 480)) -> bytes:
    file = io.BytesIO()
    Image.radial_gradient("L").resize(size).convert("RGB").save(file, "JPEG")
    return file.getvalue()


def requests_of(image: bytes) -> list[tuple[str, bytes, str, int]]:
    """(path, body, content type, the code it deserves) of each kind of request."""
    form = b'--B\r\nContent-Disposition: form-data; name="instruction"\r\n\r\nopen the drawer\r\n'
    form += b'--B\r\nContent-Disposition: form-data; name="image"; filename="a.jpg"\r\n\r\n' + image + b"\r\n--B--\r\n"

    def as_json(data: bytes) -> bytes:
        return json.dumps({"image": base64.b64encode(data).decode(), "instruction": "open the drawer"}).encode()

    return [
        (PATH, form, "multipart/form-data; boundary=B", 200),
        (PATH, as_json(image), "application/json", 200),
        (f"{PATH}?stream=1", as_json(image), "application/json", 200),
        (PATH, as_json(image[: len(image) // 2]), "application/json", 422),
        (PATH, b'{"image": "https://example.org/a.jpg", "instruction": "open"}', "application/json", 422),
    ]


def drive(address: str, kinds: list[tuple[str, bytes, str, int]], until: float, tally: Tally) -> None:
    """One client: sends one request after the other until the time is up."""
    turn = 0
    while time.monotonic() < until:
        path, body, kind, deserved = kinds[turn % len(kinds)]
        turn += 1
        started = time.monotonic()
        connection = http.client.HTTPConnection(address, timeout=300)
        tally.sent += 1
        try:
            connection.request("POST", path, body, {"Content-Type": kind})
            response = connection.getresponse()
            data = response.read()
        except (OSError, http.client.HTTPException) as error:
            tally.wrong.append(f"lost: {error!r}")
            continue
        finally:
            connection.close()
        tally.codes[response.status] += 1
        if response.status == 503:
            if not response.getheader("Retry-After"):
                tally.wrong.append("503 without Retry-After")
            time.sleep(0.05)
        elif response.status != deserved:
            tally.wrong.append(f"{response.status} instead of {deserved}: {data[:200]!r}")
        elif deserved == 200:
            if b'"status":"ok"' not in data and b'"status":"empty"' not in data:
                tally.wrong.append(f"not an affordance: {data[-200:]!r}")
            tally.seconds.append(time.monotonic() - started)


def drive_some(
    address: str, kinds: list[tuple[str, bytes, str, int]], turns: list[int], lock: threading.Lock, tally: Tally
) -> None:
    """One client: takes the next of the turns until none is left; a busy server is asked again."""
    while True:
        with lock:
            if not turns:
                return
            kind = kinds[turns.pop() % len(kinds)]
        before = tally.sent - tally.codes[503]
        while tally.sent - tally.codes[503] == before and not tally.wrong:
            drive(address, [kind], time.monotonic() + 1e-4, tally)


def memory_mib(process: int) -> float:
    """The resident memory of a process."""
    return int(subprocess.run(["ps", "-o", "rss=", "-p", str(process)], capture_output=True, check=True).stdout) / 1024


def counted(address: str) -> Counter[int]:
    """The answers to affordance requests by code, as the server counted them."""
    connection = http.client.HTTPConnection(address, timeout=10)
    connection.request("GET", "/metrics")
    text = connection.getresponse().read().decode()
    connection.close()
    found = re.findall(rf'a4_requests_total{{code="(\d+)",method="POST",path="{PATH}"}} ([\d.]+)', text)
    return Counter({int(code): round(float(count)) for code, count in found})


def serve(profile: str) -> None:
    """The server's process: prints its URL and serves until its input ends."""
    from a4agent.agent import A4Agent
    from a4agent.serve import http_server
    from a4agent.serve.admission import Limits
    from a4agent.serve.api import create_app
    from a4agent.testing import scripted_agent

    agent = scripted_agent(seconds=0.01) if profile == "scripted" else A4Agent.from_profile(profile)
    with http_server.in_thread(create_app([agent], limits=Limits(queue=8))) as url:
        print(url, flush=True)
        forget = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), forget.set())).start()
        while not forget.wait(0.2):  # scripted experts keep every request; a server that runs for ever must not
            for expert in agent.experts():
                for kept in ("requests", "batches"):
                    getattr(expert, kept, []).clear()


def soak(profile: str, clients: int, count: int) -> dict[str, object]:
    """Send `count` requests with pictures of many sizes, and read the server's memory after every tenth of them."""
    command = [sys.executable, __file__, "--server", profile]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdin
    assert server.stdout
    tallies = [Tally() for _ in range(clients)]
    memory: list[float] = []
    started = time.monotonic()
    try:
        address = urlsplit(server.stdout.readline().strip()).netloc
        kinds = [kind for size in SIZES for kind in requests_of(photo(size))]
        for tenth in range(10):
            turns, lock = list(range(tenth * count // 10, (tenth + 1) * count // 10)), threading.Lock()
            threads = [
                threading.Thread(target=drive_some, args=(address, kinds, turns, lock, tally)) for tally in tallies
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            memory.append(round(memory_mib(server.pid), 1))
            print(f"{(tenth + 1) * count // 10} requests: {memory[-1]} MiB", file=sys.stderr, flush=True)
    finally:
        server.stdin.close()
        server.wait(30)
    wrong = [reason for tally in tallies for reason in tally.wrong]
    growth = max(memory) / memory[0] - 1
    if growth > 0.05:
        wrong.append(f"memory grew by {growth:.1%} after the first tenth")
    codes = sum((tally.codes for tally in tallies), Counter[int]())
    return {
        "clients": clients,
        "seconds": round(time.monotonic() - started, 1),
        "requests": sum(codes.values()) - codes[503],
        "codes": {str(code): number for code, number in sorted(codes.items())},
        "memory_mib": memory,
        "growth": f"{growth:+.1%}",
        "wrong": wrong[:20],
    }


def measure(profile: str, clients: int, seconds: float) -> dict[str, object]:
    """Start a server, load it, and say what happened."""
    command = [sys.executable, __file__, "--server", profile]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdin
    assert server.stdout
    try:
        address = urlsplit(server.stdout.readline().strip()).netloc
        kinds = requests_of(photo())
        tallies = [Tally() for _ in range(clients)]
        started = time.monotonic()
        until = started + seconds
        threads = [
            threading.Thread(
                target=drive, args=(address, kinds[i % len(kinds) :] + kinds[: i % len(kinds)], until, tally)
            )
            for i, tally in enumerate(tallies)
        ]
        for thread in threads:
            thread.start()
        time.sleep(seconds / 3)
        early = max(memory_mib(server.pid) for _ in range(3))
        for thread in threads:
            thread.join()
        took = time.monotonic() - started
        late, theirs = memory_mib(server.pid), counted(address)
    finally:
        server.stdin.close()
        server.wait(30)
    codes = sum((tally.codes for tally in tallies), Counter[int]())
    times = sorted(second for tally in tallies for second in tally.seconds)
    wrong = [reason for tally in tallies for reason in tally.wrong]
    if theirs != codes:
        wrong.append(f"the server counted {dict(theirs)}, the clients {dict(codes)}")
    if late > 1.1 * early + 8:
        wrong.append(f"memory grew from {early:.0f} to {late:.0f} MiB")
    return {
        "clients": clients,
        "seconds": round(took, 1),
        "sent": sum(tally.sent for tally in tallies),
        "codes": {str(code): count for code, count in sorted(codes.items())},
        "answers_per_second": round(codes[200] / took, 1),
        "median_seconds": round(statistics.median(times), 3) if times else None,
        "p95_seconds": round(times[int(0.95 * (len(times) - 1))], 3) if times else None,
        "memory_mib": [round(early, 1), round(late, 1)],
        "wrong": wrong[:20],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", default="scripted")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--requests", type=int, default=0, help="send so many instead, of many sizes")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--server", metavar="PROFILE", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.server:
        serve(options.server)
        return 0
    if options.requests:
        found = soak(options.profile, options.clients, options.requests)
    else:
        found = measure(options.profile, options.clients, options.seconds)
    if options.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:20} {value}")
    return 1 if found["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
