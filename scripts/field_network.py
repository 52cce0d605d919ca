#!/usr/bin/env python3
"""Reproduces troubles of real networks in network namespaces, with the command line and its simulated PLC.

    cargo build --features cli
    sudo scripts/field_network.py [target/debug/fatek]

It needs Linux, root and `ip` (iproute2). It makes two namespaces, a client and a PLC, with a cable between them,
and removes them at the end. Each line printed is a trouble, what was seen, and the limit. The exit status is 0 if
all are within their limits, 1 if one is not, and 77 if namespaces cannot be made here.
"""

import contextlib
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time

CLIENT, PLC = f"fatek-client-{os.getpid()}", f"fatek-plc-{os.getpid()}"
LIVE, DEAD = "10.99.0.7", "10.99.0.2"
FAILED = []


def ip(*args):
    subprocess.run(["ip", *args], check=True, capture_output=True, text=True)


@contextlib.contextmanager
def network():
    """Two namespaces with a cable. The name `plc.test` has two addresses, the first of a host that is off."""
    hosts = pathlib.Path(f"/etc/netns/{CLIENT}")
    try:
        for namespace in (CLIENT, PLC):
            ip("netns", "add", namespace)
            ip("-n", namespace, "link", "set", "lo", "up")
        ip("link", "add", "cable", "netns", CLIENT, "type", "veth", "peer", "name", "cable", "netns", PLC)
        for namespace, address in ((CLIENT, "10.99.0.1"), (PLC, LIVE)):
            ip("-n", namespace, "address", "add", f"{address}/24", "dev", "cable")
            ip("-n", namespace, "link", "set", "cable", "up")
        hosts.mkdir(parents=True)
        (hosts / "hosts").write_text(f"127.0.0.1 localhost\n{DEAD} plc.test\n{LIVE} plc.test\n")
        yield
    finally:
        for namespace in (CLIENT, PLC):
            subprocess.run(["ip", "netns", "del", namespace], check=False, capture_output=True)
        (hosts / "hosts").unlink(missing_ok=True)
        if hosts.exists():
            hosts.rmdir()


def command(namespace, *args):
    return ["ip", "netns", "exec", namespace, *args]


@contextlib.contextmanager
def simulator(fatek):
    args = [fatek, "sim", "--listen", f"tcp://{LIVE}:500", "--listen", f"udp://{LIVE}:500"]
    process = subprocess.Popen(command(PLC, *args), stdout=subprocess.PIPE, text=True)
    try:
        for _ in range(2):
            assert process.stdout.readline().startswith("listening"), "the simulator does not listen"
        yield process
    finally:
        process.kill()
        process.wait()


def read(fatek, url, *args):
    """Returns exit status, seconds and stderr of one read."""
    began = time.monotonic()
    process = subprocess.run(
        command(CLIENT, fatek, "read", "R0", "--link", url, "--station", "1", *args), capture_output=True, text=True)
    return process.returncode, time.monotonic() - began, process.stderr.strip()


def report(trouble, seen, limit, good):
    print(f"{'ok  ' if good else 'FAIL'} {trouble}: {seen} (limit: {limit})", flush=True)
    if not good:
        FAILED.append(trouble)


def switched_off(fatek):
    """Before: 3 of 4 reads of a host that is off said that it did not answer."""
    results = [read(fatek, f"tcp://{DEAD}", "--timeout", "300ms") for _ in range(10)]
    said = sum(status == 5 and "cannot connect" in text for status, _, text in results)
    report("host is switched off", f"{said} of 10 reads say that they cannot connect", "10", said == 10)


def two_addresses(fatek):
    """Before: a first address that is off was the only one tried; over UDP, status 4 after 3.0 s, and later so
    in 1 of 16 reads, since addresses were skipped at random."""
    for scheme, limit in (("tcp", 2), ("udp", 2)):
        results = [read(fatek, f"{scheme}://plc.test:500") for _ in range(8)]
        status, took, text = max(results, key=lambda result: result[:2])
        seen = f"8 reads, the worst with status {status} after {took:.1f} s {text}"
        report(f"name with two addresses, the first off, {scheme}", seen, f"{limit} s", status == 0 and took < limit)


class Watch:
    """`fatek watch` in the client's namespace. Its samples, with their times."""

    def __init__(self, fatek, url):
        args = [fatek, "watch", "R0", "--link", url, "--station", "1", "--interval", "100ms", "--format", "json"]
        self.file = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(command(CLIENT, *args), stdout=self.file, stderr=subprocess.DEVNULL)

    def good(self):
        """The number of good samples up to now."""
        self.file.seek(0)
        lines = [json.loads(line) for line in self.file.read().splitlines() if line.endswith("}")]
        return sum(GOOD(line) for line in lines)

    def until_good(self, limit):
        """Waits for a good sample from now on. Returns the seconds."""
        began, before = time.monotonic(), self.good()
        while time.monotonic() - began < limit and self.good() == before:
            time.sleep(0.05)
        return time.monotonic() - began

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait()


def GOOD(sample):
    return sample.get("quality") == "good"


def cable_pulled(fatek):
    """The retransmissions of TCP back off while the cable is pulled; a new connection does not wait for them."""
    for scheme, limit in (("tcp", 6), ("udp", 6)):
        with simulator(fatek):
            watch = Watch(fatek, f"{scheme}://{LIVE}:500")
            first = watch.until_good(10)
            ip("-n", PLC, "link", "set", "cable", "down")
            time.sleep(12)
            ip("-n", PLC, "link", "set", "cable", "up")
            took = watch.until_good(limit + 5)
            watch.stop()
        seen = f"first value after {first:.1f} s, and {took:.1f} s after the cable is back"
        report(f"cable pulled for 12 s, {scheme}", seen, f"{limit} s", first < 10 and took < limit)


def restarted(fatek):
    """A module that is switched off and on forgets its connections, and says nothing of it."""
    with simulator(fatek):
        watch = Watch(fatek, f"tcp://{LIVE}:500")
        watch.until_good(10)
        ip("-n", PLC, "link", "set", "cable", "down")
    # The simulator has gone while the cable was pulled: the client's kernel was told nothing.
    with simulator(fatek):
        ip("-n", PLC, "link", "set", "cable", "up")
        took = watch.until_good(11)
        watch.stop()
    report("module switched off and on, tcp", f"{took:.1f} s until the next value", "6 s", took < 6)


def main():
    fatek = str(pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "target/debug/fatek").resolve())
    if not pathlib.Path(fatek).is_file():
        print(f"{fatek} is missing: build it with `cargo build --features cli`", file=sys.stderr)
        return 2
    with contextlib.ExitStack() as stack:
        try:
            if shutil.which("ip") is None:
                raise OSError("there is no `ip`")
            stack.enter_context(network())
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"skipped: network namespaces cannot be made here: {error}", file=sys.stderr)
            return 77
        print(f"two namespaces with a cable, {fatek}")
        switched_off(fatek)
        with simulator(fatek):
            two_addresses(fatek)
        cable_pulled(fatek)
        restarted(fatek)
    return 1 if FAILED else 0


if __name__ == "__main__":
    sys.exit(main())
