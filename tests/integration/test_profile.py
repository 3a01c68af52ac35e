"""How a profile's samples are sorted, against stacks as py-spy writes them."""

from collections import Counter

import pytest

from tests.benchmarks.profile import RAY, sorted_samples, spent_on, work_of

LOOP = "main_loop (ray/_private/worker.py:1069);executor (ray/_private/function_manager.py:740)"
COLLECT = f"{LOOP};RolloutNode.collect (actors/rollout/node.py:70);RolloutWorker.collect (actors/rollout/worker.py:85)"


@pytest.mark.parametrize(
    ("stack", "work"),
    [
        (f"{COLLECT};SwarmVectorEnv.step (sim_core/envs.py:187);WorldBatch.step (sim_core/worlds.py:96)", "simulation"),
        (f"{COLLECT};Policy.greedy (actors/policy/network.py:148)", "policy"),
        (f"{COLLECT};Policy.greedy (actors/policy/policy.py:9);StateKernel.__call__ (sim_core/jit.py:60)", "policy"),
        (f"{COLLECT};_any (numpy/_core/_methods.py:61)", "transitions and blocks"),
        (
            f"{LOOP};LearnerNode.update (learner/update/learner_node.py:1);"
            "CompiledUpdates._run (learner/update/compiled_updates.py:108)",
            "updates",
        ),
        (f"{LOOP};ShardNode.sample (actors/replay/node.py:1);choice (numpy/random.py:1)", "replay"),
        (f"{LOOP};RolloutNode._push (actors/rollout/node.py:2);remote (ray/actor.py:945)", RAY),
        ("TrainingLoop.run (learner/loop.py:112);fmean (statistics.py:1)", "training loop"),
        ("_bootstrap (threading.py:1002);select (selectors.py:468)", RAY),
    ],
)
def test_a_sample_is_for_what_its_innermost_known_frame_says(stack, work):
    assert work_of(stack) == work
    lines = [f"thread (12): MainThread;{stack} 3", f"thread (12): MainThread;{stack} 4", f"thread (9): a b;{stack} 5"]
    assert sorted_samples(lines) == {12: Counter({work: 7}), 9: Counter({work: 5})}


def test_a_threads_time_is_shared_by_its_samples_and_what_no_sample_shows_is_rays():
    samples = {1: Counter({"updates": 60, RAY: 20}), 2: Counter({"training loop": 1})}
    assert spent_on({1: 8.0, 2: 1.0, 3: 0.5}, samples) == {"updates": 6.0, RAY: 2.5, "training loop": 1.0}
    assert spent_on({7: 3.0}, {}) == {RAY: 3.0}
