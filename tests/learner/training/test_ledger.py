"""The accounts balance with and without losses, and do not when a hop loses or doubles a block unnoticed."""

import json

import numpy as np
import pytest

from actors.service.messages import BlockHeader, BlockReport, Delivered, Dropped, EpisodeStats
from learner.training.ledger import Ledger


def report(rows, made, worker_id=0, shard=0, shard_incarnation=0, dropped=None, episodes=2, env_steps=100):
    header = BlockHeader(2, worker_id, 0, 0, 0, 0.0, 0.5, env_steps, made)
    stats = EpisodeStats(np.zeros(episodes, np.int8), np.zeros(episodes, np.int32), np.zeros(episodes))
    stored = 0 if dropped else rows
    return BlockReport(header, stats, stored, 0, 0.0, rows, shard, shard_incarnation, dropped)


@pytest.fixture
def ledger():
    return Ledger(2, [1_000, 1_000])


def balances(ledger):
    """Whether every transition that was produced is stored or dropped."""
    return ledger.produced == ledger.stored + sum(ledger.dropped.values())


def totals(ledger):
    return ledger.produced, ledger.stored, sum(ledger.dropped.values()), ledger.episodes


def test_stored_blocks_balance(ledger):
    assert [
        ledger.record_block(report(90, 90)),
        ledger.record_block(report(100, 190, shard=1)),
        ledger.record_block(report(80, 80, 1)),
    ] == [
        90,
        100,
        80,
    ]
    assert totals(ledger) == (270, 270, 0, 6) and balances(ledger)
    assert ledger.replay_size == 270


@pytest.mark.parametrize("reason", Dropped)
def test_dropped_blocks_balance_under_their_reason(ledger, reason):
    assert ledger.record_block(report(90, 90, dropped=reason)) == 0
    assert totals(ledger) == (90, 0, 90, 2) and balances(ledger)
    assert ledger.dropped[reason] == 90 and ledger.replay_size == 0


def test_an_unreported_block_unbalances_the_accounts(ledger):
    ledger.record_block(report(90, 90))
    ledger.record_block(report(100, 290))  # 100 more were produced in between
    assert not balances(ledger)
    assert totals(ledger) == (290, 190, 0, 4)


def test_a_block_that_is_reported_twice_unbalances_the_accounts(ledger):
    for _ in range(2):
        ledger.record_block(report(90, 90))
    assert not balances(ledger)


def test_a_full_shard_holds_its_capacity(ledger):
    for i in range(1, 4):
        ledger.record_block(report(600, 600 * i))
    assert ledger.replay_size == 1_000 and ledger.stored == 1_800


def test_what_a_lost_worker_delivered_counts_as_stored(ledger):
    ledger.record_block(report(90, 90))
    ledger.record_block(report(100, 190, shard=1))
    # Shard 0 has stored one more block of 100 that nobody reported; the one before, of 50, never arrived.
    unreported = ledger.write_off_worker(0, [Delivered(190, 200, 5, 340), Delivered(100, 100, 2, 190)])
    assert unreported == Delivered(100, 100, 3, 0)
    assert totals(ledger) == (340, 290, 50, 7) and balances(ledger)
    assert ledger.dropped[Dropped.WORKER_LOST] == 50
    assert ledger.replay_size == 290
    ledger.record_block(report(80, 80))  # its replacement counts from 0
    assert totals(ledger) == (420, 370, 50, 9) and balances(ledger)


def test_a_lost_worker_that_had_reported_everything_changes_nothing(ledger):
    ledger.record_block(report(90, 90))
    assert ledger.write_off_worker(0, [Delivered(90, 100, 2, 90), Delivered()]) == Delivered()
    assert totals(ledger) == (90, 90, 0, 2)


def test_a_lost_shard_is_empty_and_its_share_is_returned(ledger):
    ledger.record_block(report(300, 300))
    ledger.record_block(report(100, 400, shard=1))
    assert ledger.write_off_shard(0, 4) == 0.75
    assert ledger.replay_size == 100
    assert ledger.write_off_shard(1, 5) == 1.0
    assert ledger.write_off_shard(1, 6) == 0.0
    assert ledger.replay_size == 0 and balances(ledger)


def test_a_block_that_was_pushed_to_a_lost_shard_counts_as_dropped(ledger):
    ledger.write_off_shard(0, 4)
    assert ledger.record_block(report(90, 90)) == 0
    assert ledger.record_block(report(100, 190, shard_incarnation=4)) == 100
    assert ledger.dropped[Dropped.SHARD_LOST] == 90 and balances(ledger) and ledger.replay_size == 100


def test_a_worker_lost_after_a_shard_is_settled_with_the_new_shard_only(ledger):
    ledger.record_block(report(90, 90))
    ledger.write_off_shard(0, 4)
    ledger.record_block(report(50, 140, shard_incarnation=4))
    unreported = ledger.write_off_worker(0, [Delivered(60, 100, 2, 150), Delivered()])
    assert unreported.rows == 10 and totals(ledger)[:3] == (150, 150, 0)


def test_the_row_has_the_accounts(ledger):
    ledger.record_block(report(90, 90))
    ledger.record_block(report(10, 100, dropped=Dropped.OUTDATED))
    expected = {"produced": 100.0, "stored": 90.0, "dropped": 10.0, "episodes": 4.0}
    assert ledger.row() == {f"account/{name}": value for name, value in expected.items()}


def test_a_restored_state_goes_on(ledger):
    ledger.record_block(report(90, 90))
    ledger.record_block(report(10, 100, dropped=Dropped.SHARD_LOST))
    resumed = Ledger(2, [1_000, 1_000])
    resumed.set_state(json.loads(json.dumps(ledger.get_state())))
    assert resumed.get_state() == ledger.get_state() and resumed.replay_size == 90
    resumed.record_block(report(70, 70))  # of the next incarnation, which counts from 0
    assert totals(resumed) == (170, 160, 10, 6) and balances(resumed)
