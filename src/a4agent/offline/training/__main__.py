"""`python -m a4agent.offline.training`, which `make train` runs: draw, train, export, and write the card.

Everything is kept in `--work`; a run that was stopped goes on from there.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import multiprocessing
from pathlib import Path

import numpy as np

from a4agent.errors import A4Error
from a4agent.offline import eye
from a4agent.offline.training import shards, simulator
from a4agent.offline.training.export import difference, export, measure, write_card
from a4agent.offline.training.train import TrainSettings, train
from a4agent.sim.assets import check_installed
from a4agent.sim.catalogue import built_in

DRAWN_SHARDS, SIMULATED_SHARDS = 66, 16
HELD_OUT_SEED = 1_000_003
log = logging.getLogger(__name__)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m a4agent.offline.training", description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("out/training"), help="shards and checkpoint")
    parser.add_argument("--out", type=Path, default=eye.WEIGHTS, help="the network's file; the card goes beside it")
    parser.add_argument("--minutes", type=float, default=TrainSettings.minutes, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")

    folder = options.work / "shards"
    drawer = multiprocessing.get_context("spawn").Process(target=draw_all, args=(folder, options.seed), daemon=True)
    drawer.start()
    shards.draw_shard(folder, options.seed, DRAWN_SHARDS)  # one for the start; the drawer begins at 0
    settings = TrainSettings(minutes=options.minutes, threads=options.threads, seed=options.seed)
    network, steps = train(folder, options.work / "checkpoint.pt", settings)
    drawer.terminate()

    export(network, options.out)
    apart = difference(network, options.out)
    measured = measure(network, shards.draw_shard(options.work / "held_out", HELD_OUT_SEED, 0))
    text = write_card(settings, steps, len(shards.found(folder)), measured, apart)
    options.out.with_name("eye_card.md").write_text(text, encoding="utf-8")
    log.info("wrote %s: %s", options.out, measured)


def draw_all(folder: Path, seed: int) -> None:
    """All shards; those of the simulator among them where its assets are installed."""
    try:
        check_installed(built_in())
        simulated = SIMULATED_SHARDS
    except A4Error as error:
        log.warning("no scenes of the simulator: %s", error)
        simulated = 0
    for index in range(DRAWN_SHARDS):
        shards.draw_shard(folder, seed, index)
        if simulated and index % (DRAWN_SHARDS // simulated) == 0:
            path = folder / f"shard-sim-{index:05d}.npz"
            if not path.exists():
                rng = np.random.default_rng([seed, index])
                drawn = simulator.crops(built_in(), rng, simulator.training_things(built_in()))
                shards.write(path, list(itertools.islice(drawn, shards.SIZE)))


if __name__ == "__main__":
    main()
