#!/usr/bin/env python3
"""Draws the plots of docs/PERFORMANCE.md from the CSV files beside this one.

    pip install matplotlib
    python3 docs/performance/plot.py          # all of them, as SVG
    python3 docs/performance/plot.py --png    # as PNG, to look at
"""

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


PLOTS = {"codec": plot_codec}


def main():
    form = "png" if "--png" in sys.argv[1:] else "svg"
    for name, plot in PLOTS.items():
        metadata = {"Date": None} if form == "svg" else {}
        plot().savefig(HERE / f"{name}.{form}", metadata=metadata, dpi=90)


if __name__ == "__main__":
    main()
