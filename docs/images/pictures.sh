#!/bin/sh
# Makes the pictures of docs/: simulated PLCs whose values change, and scripts/screenshot.py. Needs tmux.
#
#     cargo build --release --features cli && docs/images/pictures.sh
set -eu
cd "$(dirname "$0")/../.."

fatek=${FATEK:-target/release/fatek}
config="--config docs/images/plant.toml"
pids=
trap 'kill $pids' EXIT
$fatek sim --listen tcp://127.0.0.1:5101 --set R12:f32=60 R20-R24:text=AB-1234 >/dev/null & pids="$pids $!"
$fatek sim --listen udp://127.0.0.1:5102 --set R12:f32=75 R20-R24:text=AB-1233 >/dev/null & pids="$pids $!"
sleep 1
$fatek -q $config --plc mixer run
$fatek -q $config --plc boiler run

# Changes the values.
waves() {
    step=0
    while :; do
        step=$((step + 1))
        up=$((step % 24)) down=$((24 - step % 24))
        wave=$((up < down ? up : down))
        $fatek -q $config --plc mixer write R5=$((500 + 40 * wave)) "R10:f32=$((55 + (step * 7 + wave) % 5)).$((step % 10))" \
            M100=$((wave / 6 % 2)) DR100=$((81500 + 3 * step))
        $fatek -q $config --plc boiler write R5=$((900 - 25 * wave)) "R10:f32=$((70 + wave / 3)).5" \
            M100=1 DR100=$((40200 + step))
        sleep 0.15
    done
}
waves & pids="$pids $!"

scripts/screenshot.py top --wait 12 --keys Down Down -- $fatek $config @all top --interval 200ms
scripts/screenshot.py top-write --wait 6 --keys Down Down w 62.5 Enter -- $fatek $config @all top --interval 200ms
scripts/screenshot.py plot --wait 30 -- $fatek $config @mixer @boiler watch --plot level --interval 250ms
