"""n-step transitions against a reference that sees whole episodes of one environment."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.rollout.nstep import NStepAssembler, Steps
from actors.service.messages import transition_dtype
from actors.service.packing import packed_dtype
from tests.packed import unpack

DTYPE = transition_dtype(gym.spaces.Box(-1e6, 1e6, (2,), np.float32))
ROW = packed_dtype(DTYPE)
RUNS, TERMINATES, TRUNCATES, WAITS = 0, 1, 2, 3
DISCOUNT = 0.9


def reference(rewards, ends, n_step):
    """Rows (start, action, return, discount, next state) of one environment, oldest first."""
    rows, start = [], 0
    for stop in [*np.flatnonzero(ends) + 1, len(ends)]:
        if stop > start and ends[stop - 1] == WAITS:
            start = stop  # a step that is none
        ended = stop > start and ends[stop - 1] != RUNS
        for t in range(start, stop):
            last = min(t + n_step, stop)
            if last - t < n_step and not ended:
                continue  # pending: rewards are missing
            value = sum(DISCOUNT**k * rewards[t + k] for k in range(last - t))
            terminal = last == stop and ends[stop - 1] == TERMINATES
            rows.append((t, t % 7, value, 0.0 if terminal else DISCOUNT ** (last - t), last))
        start = stop
    return rows


def steps_of(rewards, ends, steps):
    """Env steps `steps` of `rewards` and `ends` `[steps, num_envs]`; an observation is (environment, step)."""
    env, t = np.meshgrid(np.arange(rewards.shape[1]), list(steps))
    seen = np.stack([env, t], axis=-1).astype(np.float32)
    chosen = ends[list(steps)]
    done = (chosen == TERMINATES) | (chosen == TRUNCATES)
    after = seen + np.float32([0, 1])
    return Steps(seen, t % 7, rewards[list(steps)], after, chosen == TERMINATES, done, chosen != WAITS)


def push_all(assembler, rewards, ends, steps, cuts=()):
    """Pushes env steps in blocks that are split at `cuts`; returns all rows in order."""
    parts = np.split(np.array(steps, np.int64), sorted({cut for cut in cuts if 0 < cut < len(steps)}))
    return np.concatenate([unpack(assembler.push(steps_of(rewards, ends, part)), DTYPE) for part in parts])


def of_env(rows, env):
    """Rows of one environment in order, in the format of the reference."""
    mine = rows[rows["observation"][:, 0] == env]
    assert (mine["next_observation"][:, 0] == env).all()
    columns = (mine["observation"][:, 1], mine["action"], mine["reward"], mine["discount"])
    return np.column_stack([*columns, mine["next_observation"][:, 1]])


@st.composite
def histories(draw):
    num_envs, steps = draw(st.integers(1, 3)), draw(st.integers(1, 14))
    flags = st.lists(st.sampled_from([RUNS, RUNS, TERMINATES, TRUNCATES, WAITS]), min_size=steps, max_size=steps)
    ends = np.array([draw(flags) for _ in range(num_envs)]).T
    for step, env in zip(*np.nonzero(ends == WAITS), strict=True):
        if step == 0 or ends[step - 1, env] == RUNS:
            ends[step, env] = RUNS  # only where an episode has ended does a robot wait
    rewards = np.random.default_rng(draw(st.integers(0, 99))).normal(size=ends.shape)
    return rewards, ends


@given(history=histories(), n_step=st.integers(1, 5), cuts=st.sets(st.integers(1, 13)))
@settings(max_examples=300, deadline=None)
def test_transitions_equal_the_reference_per_environment_and_in_order(history, n_step, cuts):
    rewards, ends = history
    assembler = NStepAssembler(ROW, rewards.shape[1], n_step, DISCOUNT)
    rows = push_all(assembler, rewards, ends, range(len(rewards)), cuts)
    expected = [reference(rewards[:, env], ends[:, env], n_step) for env in range(rewards.shape[1])]
    assert len(rows) == sum(map(len, expected))
    for env, wanted in enumerate(expected):
        np.testing.assert_allclose(of_env(rows, env), np.reshape(wanted, (-1, 5)), rtol=1e-5, atol=1e-6)


@given(history=histories(), n_step=st.integers(1, 5), data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_restored_assembler_continues_identically(history, n_step, data):
    rewards, ends = history
    cut = data.draw(st.integers(0, len(rewards)))
    whole = NStepAssembler(ROW, rewards.shape[1], n_step, DISCOUNT)
    push_all(whole, rewards, ends, range(cut))
    saved = whole.get_state()
    resumed = NStepAssembler(ROW, rewards.shape[1], n_step, DISCOUNT)
    push_all(resumed, rewards + 5, ends, range(min(2, len(rewards))))  # its previous content must not matter
    expected = push_all(whole, rewards, ends, range(cut, len(rewards)))  # must not change the saved state
    resumed.set_state(saved)
    np.testing.assert_array_equal(push_all(resumed, rewards, ends, range(cut, len(rewards))), expected)


@pytest.mark.parametrize(
    ("end", "discounts"), [(TERMINATES, [0, 0, 0]), (TRUNCATES, [0.9**3, 0.9**2, 0.9]), (RUNS, [0.9**3])]
)
def test_termination_has_discount_0_and_truncation_keeps_it(end, discounts):
    rewards, ends = np.array([[1.0], [2.0], [4.0]]), np.array([[RUNS], [RUNS], [end]])
    rows = push_all(NStepAssembler(ROW, 1, 3, DISCOUNT), rewards, ends, range(3))
    np.testing.assert_allclose(rows["discount"], discounts, rtol=1e-6)
    returns = [1 + 0.9 * 2 + 0.81 * 4, 2 + 0.9 * 4, 4.0]
    np.testing.assert_allclose(rows["reward"], returns[: len(rows)], rtol=1e-6)


@given(history=histories(), n_step=st.integers(1, 5), cut=st.integers(0, 6))
@settings(max_examples=100, deadline=None)
def test_only_next_observations_without_a_row_become_frames(history, n_step, cut):
    rewards, ends = history
    assembler = NStepAssembler(ROW, rewards.shape[1], n_step, DISCOUNT)
    for part in (range(cut), range(cut, len(rewards))):
        packed = assembler.push(steps_of(rewards, ends, [step for step in part if step < len(rewards)]))
        begun = set(map(tuple, packed.rows["observation"].tolist()))
        reached = unpack(packed, DTYPE)["next_observation"].astype(int)
        ended = [ends[t - 1, env] != RUNS for env, t in reached.tolist()]
        expected = [end or (env, t) not in begun for end, (env, t) in zip(ended, reached.tolist(), strict=True)]
        np.testing.assert_array_equal(packed.rows["next_row"] <= 0, expected)
        assert len(packed.frames) == sum(expected)


@given(history=histories(), n_step=st.integers(1, 5), block=st.integers(1, 6))
@settings(max_examples=100, deadline=None)
def test_steps_that_are_written_to_its_room_give_the_same_rows(history, n_step, block):
    rewards, ends = history
    copying, in_place = (NStepAssembler(ROW, rewards.shape[1], n_step, DISCOUNT) for _ in range(2))
    for begin in range(0, len(rewards), block):
        steps = steps_of(rewards, ends, range(begin, min(begin + block, len(rewards))))
        room = in_place.room(len(steps.done))
        for own, array in zip(room, steps, strict=True):
            own[...] = array
        room.next_observation[:-1][~steps.done[:-1]] = np.nan  # which nobody reads
        np.testing.assert_array_equal(unpack(in_place.push(room), DTYPE), unpack(copying.push(steps), DTYPE))
