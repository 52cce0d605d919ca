#!/usr/bin/env python3
"""Saves the screen of a program in a terminal as docs/images/NAME.svg. Needs tmux.

    scripts/screenshot.py NAME [options] -- COMMAND [ARGUMENT]...

The program runs in a terminal of its own. Keys are typed, if there are any, and the screen is taken after --wait
seconds more. --background starts another program before, such as a simulator; it is ended afterwards. --stage
takes the screen when a text appears on it, for pictures of a moment such as a progress bar.

    scripts/screenshot.py top --background 'target/release/fatek sim --listen tcp://127.0.0.1:5000' \\
        -- target/release/fatek top R0-R9 --link tcp://127.0.0.1:5000 --station 1
"""

import argparse
import os
import pathlib
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import unicodedata
from xml.sax.saxutils import escape

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Columns and lines of the picture, in pixels.
CELL = (8.4, 17)
MARGIN = 12
BACKGROUND, FOREGROUND = "#1d1f21", "#d6d8d6"
COLOURS = ["#1d1f21", "#e0625c", "#9bbf5f", "#e2b453", "#6f9fd8", "#b68ac6", "#66b8b0", "#d6d8d6",
           "#7c7f82", "#f2837c", "#b9dd7d", "#f7d078", "#93bdf0", "#d3aae2", "#8ad6ce", "#ffffff"]
# Blocks are drawn as rectangles: (left, top, width, height) in eighths of a cell.
BLOCKS = {chr(0x2580 + n): (0, 8 - n, 8, n) for n in range(1, 9)}
BLOCKS |= {chr(0x2590 - n): (0, 0, n, 8) for n in range(1, 8)}
BLOCKS["\u2580"] = (0, 0, 8, 4)
# Dots of Braille patterns, from bit 0: (column, row).
DOTS = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3)]


class Style:
    """Colours and weight, as set by SGR sequences."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.colours = {3: None, 4: None}
        self.bold = self.reversed = self.dim = False

    def apply(self, parameters):
        numbers = [int(number or 0) for number in parameters.replace(":", ";").split(";")]
        while numbers:
            number = numbers.pop(0)
            if number == 0:
                self.reset()
            elif number in (1, 2, 7):
                setattr(self, {1: "bold", 2: "dim", 7: "reversed"}[number], True)
            elif number == 22:
                self.bold = self.dim = False
            elif number == 27:
                self.reversed = False
            elif number in (38, 48):
                self.colours[number // 10] = extended(numbers)
            elif number in (39, 49):
                self.colours[number // 10] = None
            elif 30 <= number <= 47:
                self.colours[number // 10] = COLOURS[number % 10]
            elif 90 <= number <= 107:
                self.colours[3 if number < 100 else 4] = COLOURS[8 + number % 10]

    def look(self):
        """Foreground, background (None: that of the terminal), and weight."""
        foreground, background = self.colours[3] or FOREGROUND, self.colours[4]
        if self.reversed:
            foreground, background = background or BACKGROUND, foreground
        return foreground, background, self.bold, self.dim


def extended(numbers):
    """The colour behind 38 or 48: one of 256, or red, green and blue."""
    if numbers.pop(0) == 2:
        return "#" + "".join(f"{numbers.pop(0):02x}" for _ in range(3))
    number = numbers.pop(0)
    if number < 16:
        return COLOURS[number]
    if number >= 232:
        return "#" + f"{8 + 10 * (number - 232):02x}" * 3
    number -= 16
    levels = (number // 36, number // 6 % 6, number % 6)
    return "#" + "".join(f"{55 + 40 * level if level else 0:02x}" for level in levels)


def cells(screen):
    """Each character of the screen: (line, column, character, look)."""
    style = Style()
    for line, text in enumerate(screen.split("\n")):
        column = 0
        for part in re.split(r"(\x1b\[[0-9;:]*m)", text):
            if part.startswith("\x1b"):
                style.apply(part[2:-1])
                continue
            for character in part:
                yield line, column, character, style.look()
                column += 2 if unicodedata.east_asian_width(character) in "WF" else 1


def svg(screen, columns, lines, title):
    width, height = columns * CELL[0] + 2 * MARGIN, lines * CELL[1] + 2 * MARGIN
    backgrounds, shapes, runs = [], [], []
    for line, column, character, look in cells(screen):
        foreground, background, bold, dim = look
        left, top = MARGIN + column * CELL[0], MARGIN + line * CELL[1]
        if background:
            backgrounds.append((left, top, CELL[0], CELL[1], background))
        if character in BLOCKS:
            x, y, w, h = BLOCKS[character]
            shapes.append((left + x * CELL[0] / 8, top + y * CELL[1] / 8, w * CELL[0] / 8, h * CELL[1] / 8, foreground))
        elif "\u2800" <= character <= "\u28ff":
            for bit, (x, y) in enumerate(DOTS):
                if ord(character) - 0x2800 >> bit & 1:
                    shapes.append((left + (2 * x + 0.5) * CELL[0] / 4, top + (y + 0.2) * CELL[1] / 4,
                                   CELL[0] / 4, CELL[1] / 7, foreground))
        elif character != " ":
            kind = (line, foreground, bold, dim)
            if runs and runs[-1][0] == kind and runs[-1][1] + len(runs[-1][2]) == column:
                runs[-1][2] += character
            else:
                runs.append([kind, column, character])
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
           f'height="{height:g}" font-family="ui-monospace, Menlo, Consolas, DejaVu Sans Mono, monospace" '
           f'font-size="14">',
           f"<title>{escape(title)}</title>",
           f'<rect width="100%" height="100%" rx="6" fill="{BACKGROUND}"/>']
    for rectangles in (merged(backgrounds), merged(shapes)):
        # One path for each colour: a plot has thousands of dots.
        for fill in dict.fromkeys(rectangle[4] for rectangle in rectangles):
            path = "".join(f"M{x:.5g} {y:.5g}h{w:.4g}v{h:.4g}h{-w:.4g}z" for x, y, w, h, of in rectangles if of == fill)
            out.append(f'<path fill="{fill}" d="{path}"/>')
    for (line, foreground, bold, dim), column, text in runs:
        # The length keeps the columns, with any font.
        length = f' textLength="{len(text) * CELL[0]:.5g}"' if len(text) > 1 else ""
        weight = ' font-weight="bold"' if bold else ""
        weight += ' opacity="0.6"' if dim else ""
        out.append(f'<text x="{MARGIN + column * CELL[0]:.5g}" y="{MARGIN + (line + 0.76) * CELL[1]:.5g}" '
                   f'fill="{foreground}"{weight}{length}>{escape(text)}</text>')
    return "\n".join(out) + "\n</svg>\n"


def merged(rectangles):
    """Rectangles, with neighbours of one line, height and colour as one."""
    whole = []
    for x, y, w, h, fill in rectangles:
        if whole and whole[-1][1:2] + whole[-1][3:] == [y, h, fill] and abs(whole[-1][0] + whole[-1][2] - x) < 0.01:
            whole[-1][2] += w
        else:
            whole.append([x, y, w, h, fill])
    return whole


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("name")
    parser.add_argument("--size", default="80x24", help="columns and lines [80x24]")
    parser.add_argument("--wait", type=float, default=3, help="seconds before the picture, and before the keys [3]")
    parser.add_argument("--keys", nargs="*", default=[], help="keys as of `tmux send-keys`: w 30 Enter")
    parser.add_argument("--stage", help="take the screen when this text is on it")
    parser.add_argument("--background", action="append", default=[], help="program that runs meanwhile")
    parser.add_argument("command", nargs="+")
    arguments = parser.parse_args()
    if not shutil.which("tmux"):
        sys.exit("tmux is missing")
    columns, lines = map(int, arguments.size.split("x"))

    others = [subprocess.Popen(shlex.split(command), stdout=subprocess.DEVNULL, cwd=ROOT)
              for command in arguments.background]
    folder = tempfile.TemporaryDirectory()
    # A server of its own, without the settings of the user.
    tmux = ["tmux", "-f", os.devnull, "-S", f"{folder.name}/socket"]

    def run(*command):
        return subprocess.run([*tmux, *command], check=True, capture_output=True, text=True).stdout

    try:
        time.sleep(1 if others else 0)
        environment = [f"-e{name}={value}" for name, value in
                       {"LC_ALL": "C.UTF-8", "TERM": "xterm-256color", "NO_COLOR": ""}.items()]
        # The screen stays after the end of the program.
        command = f"{shlex.join(arguments.command)}; sleep 1000"
        run("new-session", "-d", "-s", "picture", "-x", str(columns), "-y", str(lines), "-c", str(ROOT), *environment,
            command)
        run("set-option", "-g", "status", "off")
        time.sleep(arguments.wait)
        if arguments.keys:
            for keys in arguments.keys:
                run("send-keys", "-t", "picture", keys)
                time.sleep(0.2)
            time.sleep(arguments.wait)
        until = time.monotonic() + 60
        while True:
            screen = run("capture-pane", "-t", "picture", "-p", "-e", "-N").rstrip("\n")
            if not arguments.stage or arguments.stage in screen:
                break
            if time.monotonic() > until:
                sys.exit(f"the text did not appear: {arguments.stage}\n{screen}")
            time.sleep(0.05)
    finally:
        subprocess.run([*tmux, "kill-server"], capture_output=True)
        for other in others:
            other.send_signal(signal.SIGTERM)
            other.wait()
        folder.cleanup()
    path = ROOT / "docs" / "images" / f"{arguments.name}.svg"
    path.parent.mkdir(exist_ok=True)
    path.write_text(svg(screen, columns, lines, shlex.join([pathlib.Path(arguments.command[0]).name,
                                                           *arguments.command[1:]])))
    print(path.relative_to(ROOT))


main()
