#!/usr/bin/env python3
"""Drives each subcommand of `fatek` in a terminal, over TCP, UDP and a pseudo-terminal, in both framings.

    cargo build --features cli
    scripts/drive_cli.py [target/debug/fatek] [--only udp-ascii-80x24]

It needs tmux. Each command runs in a terminal of 80x24 and of 120x40 against a simulated PLC. Its exit status and
what the terminal shows are checked, and that no line of a table is wrapped. The transcript of each run is kept in
target/drive. A subcommand that is in the help and in no step is an error. The exit status is 0 if all steps passed,
1 if one did not, and 77 if tmux is missing.
"""

import argparse
import contextlib
import dataclasses
import os
import pathlib
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tty

PARSER = argparse.ArgumentParser()
PARSER.add_argument("program", nargs="?", default="target/debug/fatek")
PARSER.add_argument("--only", default="", help="run those whose name contains this")
ARGS = PARSER.parse_args()
FATEK = str(pathlib.Path(ARGS.program).resolve())
TRANSCRIPTS = pathlib.Path("target/drive").resolve()
SIZES = [(80, 24), (120, 40)]
TRANSPORTS = ["tcp", "udp", "serial"]
FRAMINGS = ["ascii", "binary"]
# A slow machine must not fail the run: a step ends when its command does.
LIMIT = 20


@dataclasses.dataclass
class Step:
    """A command, the exit status, and what the terminal shows: regular expressions of lines."""

    command: str
    seen: list = dataclasses.field(default_factory=list)
    status: int = 0
    # Keys, each sent when the text before it is shown.
    keys: list = dataclasses.field(default_factory=list)
    # No line may be longer than the terminal is wide.
    fits: bool = True
    # For these transports and framings only.
    only: tuple = ()


# {link}: the link; {line}: without framing, speed and frame; {port}: of TCP or UDP; {file}: a folder for files;
# {plant}: a plant configuration with the PLC `mixer`.
STEPS = [
    Step("status", [r"running +false", r"main_unit +MC"]),
    Step("write R0=5 R100:f32=21.5 M0-M2=1,0,1 R10-R12:text=hello", [r"^wrote R100:f32=21.5$"]),
    Step("read R0 R100:f32 M0-M2 R10-R12:text",
         [r"^R0 +u16 +5$", r"^R100 +f32 +21\.5$", r"^M1 +bool +0$", r'text +"hello"']),
    Step("read R0-R2 M0 --format json", [r'"tag": "R0"', r'"value": 5']),
    Step("read R0 --format csv", [r"^tag,type,value$", r"^R0,u16,5$"]),
    Step("write R0=-5", [r"R0:i16=-5"], status=2),
    Step("write R1=7 --verify", [r"^wrote R1=7$"]),
    Step("write R1=8 --every 200ms", [r"^wrote R1=8$"], keys=[("wrote", "C-c")]),
    Step("plan R0-R9 R12 M0 R900:f32", [r"^ +1 +13 ", r"total .* 1 request"]),
    Step("set M10-M13", [r"^set M13: done$"]),
    Step("reset M11", [r"^reset M11: done$"]),
    Step("disable M20", [r"^disable M20: done$"]),
    Step("forced M0-M30", [r"^M20 +"]),
    Step("enable M20", [r"^enable M20: done$"]),
    Step("run", [r"^run: done$"]),
    Step("stop", [r"^stop: done$"]),
    Step("ping --count 3 --interval 10ms", [r"^3: 16 bytes in [0-9.]+ ms", r"3 sent, 3 received"]),
    Step("ping --count 1000 --interval 200ms", [r"sent, .* received"], status=130, keys=[("bytes in", "C-c")]),
    Step("watch R0 M0 --count 2 --interval 50ms", [r"Z +R0 +5", r"2 poll cycles"]),
    Step("watch R0 M0 --wide --interval 100ms",
         [r"TIME +R0 +M0 +QUALITY", r"Z +5 +1 +good"], keys=[("good", "C-c")]),
    # Nothing of a display is left on the terminal: it is seen before each key.
    Step("top R0 M0 --interval 100ms", keys=[("good", "q")]),
    Step("top R60 --interval 100ms",
         keys=[("good", "w"), ("new value", "9"), (None, "Enter"), ("Write it?", "y"), ("wrote R60=9", "q")]),
    Step("read R60", [r"^R60 +u16 +9$"]),
    Step("watch --plot R0 --interval 100ms", keys=[("min 5.0", "q")]),
    Step("scan 1-3 --timeout 150ms", [r"^STATION +ANSWER", r"^1 +ok"]),
    Step("scan 1-200 --timeout 300ms", [r"^1 +ok", r"interrupted by SIGINT"], status=130, keys=[("1 found", "C-c")]),
    Step("scan --network 127.0.0.1 --{transport} {port} --stations 1-2 --timeout 300ms",
         [r"^LINK +STATION +ANSWER", r"^(tcp|udp)://127\.0\.0\.1:\S+ +1 +ok", r"hint: to read more: fatek "],
         only=("tcp",)),
    Step("scan --network 127.0.0.1 --{transport} {port} --stations 1-2 --timeout 300ms",
         [r"^LINK +STATION +ANSWER", r"^udp://127\.0\.0\.1:\S+ +1 +ok"], only=("udp",)),
    Step("scan --network 127.0.1.0/24 --{transport} {port} --rate 20", [r"interrupted by SIGINT"], status=130,
         keys=[(" of 254 hosts", "C-c")], only=("tcp",)),
    Step("scan --discover --broadcast 127.0.0.1 --source-port 0 --timeout 300ms",
         [r"unverified on hardware", r"^error: no module answered$"], status=4, only=("tcp", "ascii")),
    Step("ports", [r"^(PORT +DRIVER|no serial ports)"], only=("tcp", "ascii")),
    Step("detect {line} --stations 1-2 --timeout 300ms", [r"^LINK +STATION +ANSWER", r"^tcp:\S+ +1 +sure"],
         only=("tcp",)),
    Step("detect {line} --baud 9600,115200 --frame 7E1,8N1 --stations 1 --timeout 300ms",
         # A pseudo-terminal has no speed: the first one with this framing is found.
         [r"^trying 4 settings with station 1: 6 requests", r"^serial:\S+ +1 +sure"], only=("serial",)),
    Step("clock", [r"^2026-11-29 06:30:00 +0$"]),
    Step("clock --set 2026-11-30T07:00:00", [r"the clock was set to 2026-11-30 07:00:00 weekday 1"]),
    Step("probe", [r"^48 mixed read +supported"]),
    # The simulated PLC has R65535 there.
    Step("doctor --quick --rate 500", [r"^  holds +registers-46 +answered$", r"^  contradicts +bad-address "],
         status=7),
    Step("program read {file}/p.program", [r"^error: .*binary"], status=2, only=("binary",)),
    Step("program read {file}/p.program", [r"p\.program: .* pages$"], only=("ascii",)),
    Step("program info {file}/p.program", [r"^pages +[0-9]+$"], only=("ascii",)),
    Step("program verify {file}/p.program", [r"^all [0-9]+ pages are equal$"], only=("ascii",)),
    Step("program write {file}/p.program --yes", [r"pages are equal, nothing was written"], only=("ascii",)),
    Step("backup {file}/p.backup R0-R299 M0-M99", [r"400 elements"]),
    Step("write R50=77", [r"^wrote R50=77$"]),
    Step("restore {file}/p.backup --dry-run", [r"^R50 +0 +77", r"1 of 400 elements would be written"]),
    Step("restore {file}/p.backup", [r"not confirmed"], status=1, keys=[("[y/N]", "n"), (None, "Enter")]),
    Step("restore {file}/p.backup --yes", [r"1 differed, 1 written"]),
    Step("decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03", [r"46"], only=("tcp", "ascii")),
    Step("-vv read R0 M0 2>{file}/a.log", [r"^R0 +u16 +5$"]),
    Step("decode --file {file}/a.log", [r"^ +TIME s", r"^connection 1: ", r" mixed read \(48h\) |read registers"]),
    Step("replay {file}/a.log", [r"requests sent, 0 replies differ$"]),
    Step("replay {file}/a.log --dry-run", [r"^1 +loop back|^1 +read", r"requests would be sent$"]),
    Step("replay {file}/a.log --listen tcp://127.0.0.1:0", [r"0 requests answered"], keys=[("listening", "C-c")]),
    Step("record {file}/a.recording", [r"; 0 connections"], keys=[("listening", "C-c")],
         only=("tcp",)),
    Step("record {file}/a.recording --listen udp://127.0.0.1:0", [r"; 0 connections"], keys=[("listening", "C-c")],
         only=("udp",)),
    Step("@mixer read level", [r"^level +u16 +5$"]),
    Step("--config {plant} --plc mixer watch --count 1 --interval 50ms", [r"level +5"]),
    Step("read R0 --station 9 --timeout 100ms", [r"hint: "], status=4),
    Step("completions bash", [r"complete .*fatek"], fits=False, only=("tcp", "ascii")),
    Step("man {file}/man", [r"man pages"], only=("tcp", "ascii")),
    Step("sim --listen tcp://127.0.0.1:0", [r"^listening tcp://127\.0\.0\.1:[0-9]+$"], keys=[("listening", "C-c")],
         only=("tcp", "ascii")),
    Step("-h", [r"^Values:$", r"^Options:$"], only=("tcp", "ascii")),
    Step("help read", [r"^Usage: fatek read"], only=("tcp", "ascii")),
]


class Failure(Exception):
    pass


class Terminal:
    """A terminal of tmux, with a server of its own."""

    def __init__(self, columns, rows, environment):
        self.socket = f"fatek-drive-{os.getpid()}-{columns}"
        self.columns, self.rows, self.environment = columns, rows, environment
        # Of the command, so that the end of one is not taken for that of the next.
        self.number = 0

    def __enter__(self):
        size = ["-x", str(self.columns), "-y", str(self.rows)]
        # The size is kept without a client that is attached.
        self.tmux("new-session", "-d", "-s", "drive", *size, "sleep 100000")
        self.tmux("set-option", "-g", "remain-on-exit", "on")
        self.tmux("set-option", "-g", "history-limit", "20000")
        return self

    def __exit__(self, *_):
        with contextlib.suppress(subprocess.CalledProcessError):
            self.tmux("kill-server")

    def tmux(self, *args):
        command = ["tmux", "-L", self.socket, "-f", "/dev/null", *args]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def start(self, command):
        self.number += 1
        assignments = " ".join(f"{name}={shlex.quote(value)}" for name, value in self.environment.items())
        end = f"status=$?; echo; echo \"[command {self.number}: status $status]\""
        # Ctrl-C ends the command, not the shell.
        shell = f"trap : INT; clear; env {assignments} {command}; {end}"
        self.tmux("respawn-pane", "-k", "-t", "drive", f"sh -c {shlex.quote(shell)}")
        self.tmux("clear-history", "-t", "drive")

    def keys(self, *keys):
        self.tmux("send-keys", "-t", "drive", *keys)

    def text(self, joined=False):
        """All lines, also those that have scrolled away. `joined`: wrapped lines as one."""
        flags = ["-J"] if joined else []
        return self.tmux("capture-pane", "-p", "-S", "-", *flags, "-t", "drive").rstrip("\n")

    def wait(self, is_there):
        ends = time.monotonic() + LIMIT
        while time.monotonic() < ends:
            text = self.text()
            if is_there(text):
                return text
            time.sleep(0.05)
        raise Failure(f"no end after {LIMIT} s; the terminal shows:\n{self.text()}")

    def run(self, step, command):
        self.start(command)
        for shown, key in step.keys:
            if shown is None:
                time.sleep(0.5)
            else:
                self.wait(lambda text: shown in text)
            self.keys(key)
        end = re.compile(rf"\[command {self.number}: status (\d+)\]")
        text = self.wait(end.search)
        status = int(end.search(text).group(1))
        return status, text, self.text(joined=True)


def check(step, status, text, joined, columns):
    """Returns the faults."""
    faults = []
    if status != step.status:
        faults.append(f"status {status}, expected {step.status}")
    for expression in step.seen:
        if not re.search(expression, joined, re.MULTILINE):
            faults.append(f"not shown: {expression}")
    if "panicked" in joined:
        faults.append("a panic")
    if step.fits:
        # A long message may be wrapped, a table may not; only the bytes of a status are longer.
        long = [line for line in joined.splitlines() if len(line.rstrip()) > columns]
        is_message = re.compile(r"^(error|hint|warning|[^ ]+:) |\[y/N\]|(raw|status) +[0-9A-F]+$")
        faults += [f"wrapped: {line}" for line in long if not is_message.search(line)]
    return faults


@contextlib.contextmanager
def serial_line():
    """Two pseudo-terminals that are connected; yields their paths."""
    ends = [pty.openpty() for _ in range(2)]
    for _, slave in ends:
        tty.setraw(slave)
    masters = [master for master, _ in ends]
    stop = threading.Event()

    def pump():
        while not stop.is_set():
            for ready in select.select(masters, [], [], 0.1)[0]:
                with contextlib.suppress(OSError):
                    os.write(masters[1 - masters.index(ready)], os.read(ready, 4096))

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        yield [os.ttyname(slave) for _, slave in ends]
    finally:
        stop.set()
        thread.join()
        for end in ends:
            for descriptor in end:
                os.close(descriptor)


@contextlib.contextmanager
def simulated_plc(transport, framing):
    """A simulated PLC; yields the link to it."""
    with contextlib.ExitStack() as stack:
        frame = "7E1" if framing == "ascii" else "8N1"
        if transport == "serial":
            plc_end, client_end = stack.enter_context(serial_line())
            listen = f"serial:{plc_end}?baud=115200&frame={frame}"
            link = f"serial:{client_end}?baud=115200&frame={frame}&framing={framing}"
        else:
            listen, link = f"{transport}://127.0.0.1:0", None
        command = [FATEK, "sim", "--listen", listen, "--framing", framing, "--model", "largest",
                   "--clock", "2026-11-29T06:30:00"]
        sim = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            line = sim.stdout.readline().strip()
            if not line.startswith("listening "):
                raise Failure(f"the simulated PLC does not listen: {line}")
            yield link or f"{line.removeprefix('listening ')}?framing={framing}"
        finally:
            sim.send_signal(signal.SIGTERM)
            if sim.wait() != 0:
                raise Failure(f"the simulated PLC ended with {sim.returncode}")


def subcommands():
    """The names of the subcommands, from the sections of the help."""
    text = subprocess.run([FATEK, "-h"], check=True, capture_output=True, text=True).stdout
    sections = text.partition("\nValues:")[2].partition("\nOptions:")[0]
    names = set(re.findall(r"^  ([a-z]+) ", sections, re.MULTILINE))
    if len(names) < 10:
        sys.exit("the help has no sections of commands")
    return names


def compared():
    """The commands of `fatek` in docs/COMPARE.md, each with what it shows."""
    text = pathlib.Path("docs/COMPARE.md").read_text()
    table = text.partition("## A command for each row")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| [^|]+ \| `fatek ([^`]+)` \| `([^`]+)` \|$", table, re.MULTILINE)
    if len(rows) < 10:
        sys.exit("docs/COMPARE.md has no table of commands")
    return [Step(command, [re.escape(shown)], fits=False) for command, shown in rows]


def first_command(step, names):
    """The subcommand of a step."""
    return next((word for word in step.command.split() if word in names), None)


def requests_are_planned(environment):
    """Returns a fault unless ten scattered tags are read by the requests of their plan."""
    tags = [f"R{100 * number}" for number in range(10)]
    environment = {**os.environ, **environment}
    planned = subprocess.run([FATEK, "plan", *tags], env=environment, capture_output=True, text=True).stdout
    count = int(re.search(r"(\d+) requests?$", planned, re.MULTILINE).group(1))
    log = subprocess.run([FATEK, "-vv", "read", *tags], env=environment, capture_output=True, text=True).stderr
    # The check of a new connection (4E) is no request of the plan.
    sent = len(re.findall(r"sending station=1 bytes=\\x0201(?!4E)", log))
    return [] if sent == count else [f"{count} requests are planned, and {sent} are sent:\n{log}"]


def main():
    if not shutil.which("tmux"):
        print("skipped: tmux is missing", file=sys.stderr)
        sys.exit(77)
    shutil.rmtree(TRANSCRIPTS, ignore_errors=True)
    TRANSCRIPTS.mkdir(parents=True)
    failed, count = [], 0
    names = subcommands()
    if missing := names - {first_command(step, names) for step in STEPS}:
        failed.append(f"subcommands without a step: {', '.join(sorted(missing))}")
    for transport in TRANSPORTS:
        for framing in FRAMINGS:
            for columns, rows in SIZES:
                name = f"{transport}-{framing}-{columns}x{rows}"
                if ARGS.only not in name:
                    continue
                with tempfile.TemporaryDirectory() as folder, simulated_plc(transport, framing) as link:
                    plant = f"{folder}/plant.toml"
                    pathlib.Path(plant).write_text(
                        f'[plc.mixer]\nlink = "{link}"\nstation = 1\ntag.level = "R0"\n'
                    )
                    environment = {"FATEK_LINK": link, "FATEK_STATION": "1", "FATEK_CONFIG": plant}
                    steps = [step for step in STEPS if set(step.only) <= {transport, framing}]
                    if (transport, framing) == ("tcp", "ascii"):
                        steps = steps + compared()
                    transcript = []
                    if (transport, framing) == ("tcp", "ascii"):
                        failed += [f"{name}: {fault}" for fault in requests_are_planned(environment)]
                    with Terminal(columns, rows, environment) as terminal:
                        for step in steps:
                            line = link.partition("?")[0]
                            arguments = step.command.format(link=link, line=line, transport=transport,
                                                            port=line.rpartition(":")[2], file=folder, plant=plant)
                            try:
                                status, text, joined = terminal.run(step, f"{FATEK} {arguments}")
                                faults = check(step, status, text, joined, columns)
                            except Failure as failure:
                                text, faults = "", [str(failure)]
                            count += 1
                            transcript.append(f"$ fatek {step.command}\n{text}\n")
                            failed += [f"{name}: fatek {step.command}: {fault}" for fault in faults]
                    (TRANSCRIPTS / f"{name}.txt").write_text("\n".join(transcript))
                print(f"{name}: {len(steps)} commands", flush=True)
    for fault in failed:
        print(fault, file=sys.stderr)
    if count == 0:
        failed.append("no command was run")
    print(f"{count} commands, {len(failed)} faults; transcripts in {TRANSCRIPTS}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
