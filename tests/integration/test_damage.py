"""A real checkpoint, cut or changed by one byte anywhere: never read back, and the one before it is used."""

import dataclasses
import random
from contextlib import closing
from pathlib import Path

import pytest

from learner.checkpoints.checkpoint import newest_valid
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster
from tests.checkpointing import Silent
from tests.integration.conftest import SMALL

PLACES = 240


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory) -> Path:
    """The last two checkpoints of a small run with all parts: several workers and shards."""
    folder = tmp_path_factory.mktemp("run")
    config = dataclasses.replace(SMALL, workers=2, replay_shards=2, replay="prioritised", total_env_steps=3_000)
    with closing(Journal(folder / "metrics.jsonl", 0)) as journal:
        assert TrainingLoop(
            config, ProcessCluster(config, 0), journal, folder / "checkpoints", Silent(), lambda: False
        ).run()
    return folder / "checkpoints"


def test_every_damage_at_a_random_place_is_detected(checkpoints):
    older, newest = sorted(checkpoints.iterdir())
    assert newest_valid(checkpoints)[0].folder == newest
    files = sorted(path for path in newest.rglob("*") if path.is_file() and path.stat().st_size)
    kinds = {path.relative_to(newest).parts[0] for path in files}
    expected = {"learner.safetensors", "manifest.json", "state.json"}
    expected |= {f"worker-{i}.safetensors" for i in (0, 1)} | {f"shard-{i}.zarr" for i in (0, 1)}
    assert kinds == expected
    rng, damages, hit = random.Random(0), 0, set()
    for number in range(PLACES):
        path = files[number % len(files)]  # small files as often as large ones
        whole = path.read_bytes()
        place = rng.randrange(len(whole))
        changed = bytearray(whole)
        changed[place] ^= rng.randrange(1, 256)
        for damaged in (whole[:place], bytes(changed)):
            path.write_bytes(damaged)
            found, skipped = newest_valid(checkpoints)
            assert found.folder == older, f"{path} damaged at byte {place} was used"
            assert len(skipped) == 1 and str(newest) in skipped[0]
            damages += 1
        path.write_bytes(whole)
        hit.add(path)
    assert damages == 2 * PLACES and hit == set(files)
    assert newest_valid(checkpoints)[0].folder == newest
