#!/usr/bin/env python3
"""Draws the plots of docs/PERFORMANCE.md from the CSV files beside this one.

    pip install matplotlib
    python3 docs/performance/plot.py          # all of them, as SVG
    python3 docs/performance/plot.py --png    # as PNG, to look at
"""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("svg" if "--png" not in sys.argv[1:] else "agg")
import matplotlib.pyplot as plt

sys.dont_write_bytecode = True
import codec

HERE = Path(__file__).parent
# The same files from the same figures: no dates, no random names.
plt.rcParams.update({"svg.hashsalt": "fatek", "svg.fonttype": "none", "font.size": 10, "axes.axisbelow": True})

OURS, LIMIT = "#1f6f8b", "#c8c8c8"


def plot_codec():
    """Instructions and time of each frame and job, beside their limits."""
    rows = codec.load()
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), sharey="col", layout="constrained")
    for row, framing in enumerate(["ascii", "binary"]):
        labels = [(frame, job) for frame in codec.FRAMES for job in ["encode", "decode", "client"]]
        for axis, unit in zip(axes[row], ["instructions", "ns"]):
            ours = [rows[framing, frame, job][unit] for frame, job in labels]
            limits = [rows[codec.limit_of(framing, frame, job)][unit] for frame, job in labels]
            # A gap after each frame.
            places = [n + n // 3 * 0.6 for n in range(len(labels))]
            axis.bar([place - 0.2 for place in places], ours, 0.4, color=OURS, label="fatek")
            axis.bar([place + 0.2 for place in places], limits, 0.4, color=LIMIT, label="limit: copy and checksum")
            for place, our, limit in zip(places, ours, limits):
                axis.text(place - 0.2, our, f"{our / limit:.1f}", ha="center", va="bottom", fontsize=8)
            axis.set_xticks(places, [job for _, job in labels], rotation=60)
            for n, name in enumerate(codec.FRAMES.values()):
                axis.text(n * 3.6 + 1, -0.27, name.replace(", ", "\n"), transform=axis.get_xaxis_transform(),
                          ha="center", va="top", fontsize=9)
            axis.set_title(f"{framing}, {unit} a frame (above the bars: ratio to the limit)", fontsize=10)
            axis.grid(axis="y", alpha=0.4)
            axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0][0].get_legend_handles_labels(), frameon=False, loc="outside upper center", ncols=2)
    return figure


WAYS = {
    "fatek-binary": ("read_registers, binary", "#1f77b4", "o"),
    "into-binary": ("read_registers_into, binary", "#1f77b4", "s"),
    "fatek-ascii": ("read_registers, ASCII", "#d95f02", "o"),
    "into-ascii": ("read_registers_into, ASCII", "#d95f02", "s"),
}


def label(setting):
    runtime, links, callers = setting
    who = f"{links} links" if links != "1" else "1 link"
    return f"{runtime}\n{who}, {callers} caller{'' if callers == '1' else 's'} each"


def plot_call():
    """How near calls come to the limit and to the peer."""
    rows = list(csv.DictReader((HERE / "call.csv").open()))
    settings = list(dict.fromkeys((r["runtime"], r["links"], r["callers"]) for r in rows))
    figure, axes = plt.subplots(1, 2, figsize=(12, 6.5), sharey=True)
    for axis, name, title, goal in (
        (axes[0], "limit", "a bare write and read", 0.9),
        (axes[1], "peer", "tokio-modbus", 1.0),
    ):
        axis.axvline(goal, color="#888888", linestyle="--", linewidth=1, label=f"target, {goal}")
        for offset, (way, (text, color, marker)) in enumerate(WAYS.items()):
            mine = {(r["runtime"], r["links"], r["callers"]): r for r in rows if r["way"] == way}
            for place, setting in enumerate(settings):
                row = mine.get(setting)
                if not row or not row[f"{name}_median"]:
                    continue
                low, middle, high = (float(row[f"{name}_{part}"]) for part in ("low", "median", "high"))
                y = place + (offset - 1.5) * 0.17
                axis.plot([low, high], [y, y], color=color, linewidth=2, alpha=0.45)
                axis.plot(middle, y, marker, color=color, markersize=6, label=text if place == 0 else None)
        axis.set_xlabel(f"requests a second, as a share of {title}")
        axis.set_yticks(range(len(settings)), [label(setting) for setting in settings])
        axis.grid(axis="x", alpha=0.3)
        axis.set_xlim(left=min(0.5, axis.get_xlim()[0]))
    axes[0].invert_yaxis()
    axes[0].set_title("the limit")
    axes[1].set_title("the peer")
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles[1:], labels[1:], loc="lower center", ncols=4, frameon=False)
    title = "64 registers read over loopback TCP: medians of the ratios of interleaved rounds, and their middle half"
    figure.suptitle(title)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    return figure


PLOTS = {"codec": plot_codec, "call": plot_call}


def main():
    form = "png" if "--png" in sys.argv[1:] else "svg"
    for name, plot in PLOTS.items():
        metadata = {"Date": None} if form == "svg" else {}
        plot().savefig(HERE / f"{name}.{form}", metadata=metadata, dpi=90)


if __name__ == "__main__":
    main()
