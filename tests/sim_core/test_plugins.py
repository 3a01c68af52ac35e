"""A user's own methods and scenes: the examples as oracles of each other, what travels, and what is refused how."""

import json
import os
import pickle
import textwrap
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import deploy
from sim_core import ENV_ID, ConfigError, WorldConfig, kernel_cache
from sim_core.pilot import Pilot
from sim_core.plugins import SOURCES, PluginError, _materialised
from sim_core.render import draw_world
from sim_core.worlds import WorldBatch, rehearse

EXAMPLES = Path(deploy.__file__).parent / "examples"
COMPASS, FAST_COMPASS = f"{EXAMPLES}/compass.py:Compass", f"{EXAMPLES}/compass_kernel.py:FastCompass"
CORRIDOR = f"{EXAMPLES}/corridor.py:Corridor"


def played(config, steps=60, num_worlds=8):
    """Observations `[steps, num_worlds, size]` and rewards `[steps, num_worlds]` of fixed actions."""
    worlds, rng = WorldBatch(config, num_worlds), np.random.default_rng(0)
    worlds.reset()
    results = []
    for _ in range(steps):
        result = worlds.step(rng.integers(config.num_actions, size=num_worlds))
        worlds.reset(result.outcome != 0)
        results.append(result)
    return np.stack([r.observation for r in results]), np.stack([r.reward for r in results])


def written(folder, body, base="Method", name="Mine"):
    """`FILE.py:CLASS` of a class with this body."""
    path = folder / "mine.py"
    imports = (
        "import numpy as np\nfrom sim_core.methods.base import Method\nfrom sim_core.scenes.base import Scene, Start\n"
    )
    path.write_text(f"{imports}\n\nclass {name}({base}):\n{textwrap.indent(textwrap.dedent(body).strip(), '    ')}\n")
    return f"{path}:{name}"


IMPORTS = """import numpy as np
from sim_core.methods.base import Method
from sim_core.scenes.base import Scene, Start
"""
METHOD = """
@classmethod
def observation_names(cls, config):
    return ("x", "y")

def observe(self, state):
    return np.stack([state.pos_x[:, 0], state.pos_y[:, 0]], axis=1)
"""
SCENE = """
def place(self, uniform):
    position = np.stack(np.meshgrid(np.arange(10.0), [-3.0, 3.0]), axis=-1).reshape(20, 2) * 0.5
    return Start(position, np.array([[9.0, 9.0], [-9.0, -9.0]]))
"""


def test_the_kernel_sees_what_numpy_sees():
    lost = {"position_loss": 0.3, "dropped_mates": 2}
    for settings in ({"robots": 7, "groups": 3}, {"scene": CORRIDOR}, {"robots": 7, "groups": 3, **lost}):
        plain, rewards = played(WorldConfig(method=COMPASS, **settings))
        fast, same_rewards = played(WorldConfig(method=FAST_COMPASS, **settings))
        np.testing.assert_allclose(plain, fast, atol=1e-5)
        np.testing.assert_array_equal(rewards, same_rewards)


def test_a_method_that_forgets_robots_that_are_not_sensed_is_told_so(tmp_path):
    name = written(tmp_path, METHOD)
    rehearse(WorldConfig(method=name))
    with pytest.raises(PluginError, match=r"mine.py, line \d+: observe of Mine .*not finite; robots .* are at NaN"):
        rehearse(WorldConfig(method=name, position_loss=0.5))


def test_a_compass_points_to_where_the_positions_say():
    config = WorldConfig(method=COMPASS, robots=5, groups=3)
    worlds = WorldBatch(config, 6)
    seen = worlds.reset()
    position, learner = worlds.positions().astype(float), worlds.state.learner
    for world in range(6):
        groups, own = position[world].reshape(3, 5, 2), learner[world] // 5
        at = position[world, learner[world]]
        others = np.delete(groups, own, axis=0).reshape(-1, 2)
        nearest = others[np.linalg.norm(others - at, axis=1).argmin()]
        expected = np.clip(np.concatenate([groups[own].mean(0) - at, nearest - at]), -1.5, 1.5)
        np.testing.assert_allclose(seen[world], expected, atol=1e-5)


def test_the_source_travels_with_the_settings(tmp_path):
    name = written(tmp_path, METHOD)
    config = WorldConfig(method=name)
    (tmp_path / "mine.py").unlink()
    there = pickle.loads(pickle.dumps(config))
    assert there == config and there.method_name == "Mine"
    assert WorldBatch(there, 2).reset().shape == (2, 2)
    with pytest.raises(ConfigError, match="cannot be read"):
        WorldConfig(method=name)


def test_a_file_that_lies_on_no_disk_is_taken_from_the_environment(tmp_path, monkeypatch):
    name = written(tmp_path, METHOD)
    text = (tmp_path / "mine.py").read_text()
    (tmp_path / "mine.py").unlink()
    monkeypatch.setenv(SOURCES, json.dumps({str(tmp_path / "mine.py"): text}))
    assert WorldConfig(method=name).sources == ((str(tmp_path / "mine.py"), text),)


@pytest.mark.parametrize("damage", [lambda text: text[: len(text) // 2], lambda text: "", lambda text: "\udcff"])
def test_a_damaged_copy_of_a_file_is_written_anew(tmp_path, monkeypatch, damage):
    monkeypatch.setattr(kernel_cache, "CACHE_FOLDER", str(tmp_path))
    copy = _materialised("mine.py", METHOD, "0123")
    before = copy.stat().st_mtime_ns
    assert _materialised("mine.py", METHOD, "0123") == copy and copy.stat().st_mtime_ns == before
    copy.write_text(damage(METHOD), errors="surrogateescape")
    assert _materialised("mine.py", METHOD, "0123").read_text() == METHOD
    assert len(list(copy.parent.iterdir())) == 1 and copy.stat().st_mode & 0o077 == 0o077 & ~umask() & 0o066


def umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_copy_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder can be made in a file")
    monkeypatch.setattr(kernel_cache, "CACHE_FOLDER", str(tmp_path / "file" / "kernels"))
    with pytest.raises(ConfigError, match="mine.py needs a copy in .*NUMBA_CACHE_DIR"):
        _materialised("mine.py", METHOD, "0123")


def test_gymnasium_takes_them_and_finds_nothing_wrong():
    env = gym.make(ENV_ID, method=COMPASS, scene=CORRIDOR, robots=6)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_groups_of_unequal_size():
    config = WorldConfig(scene=CORRIDOR, robots=9)
    assert config.group_sizes == (9, 4) and config.num_robots == 13 and config.setup == "Corridor 9+4r"
    worlds = WorldBatch(config, 3)
    worlds.reset()
    assert worlds.state.group.tolist() == [0] * 9 + [1] * 4 and worlds.state.learner.tolist() == [8, 8, 8]
    positions = worlds.positions()
    assert (positions[:, :9, 0] < -4).all() and (positions[:, 9:, 0] > 4).all()
    image = draw_world(positions[0], worlds.goals()[0], 8, config)
    assert image.shape == (480, 480, 3) and len(np.unique(image.reshape(-1, 3), axis=0)) > 5


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_every_method_and_the_swarm_alone_play_in_groups_of_unequal_size(method):
    config = WorldConfig(scene=CORRIDOR, robots=8, method=method, robot_radius_m=0.06)
    observation, reward = played(config)
    assert np.isfinite(observation).all() and np.isfinite(reward).all()
    worlds = WorldBatch(config, 5)
    worlds.reset()
    for _ in range(400):
        result = worlds.step(Pilot.FREE)
    assert (np.linalg.norm(worlds.positions()[:, :8] - worlds.goals()[:, :1], axis=-1).mean(1) < 1.5).all()
    assert np.isfinite(result.observation).all()


def test_worlds_of_a_scene_are_independent_of_their_batch():
    config = WorldConfig(scene=CORRIDOR, robots=6)
    together, alone = WorldBatch(config, 4), WorldBatch(config, 1)
    together.seed([5, 6, 7, 8])
    alone.seed([7])
    together.reset()
    alone.reset()
    np.testing.assert_array_equal(together.positions()[2], alone.positions()[0])
    assert not np.array_equal(together.positions()[1], together.positions()[2])


def test_a_scene_that_names_no_learning_robot_draws_all_alike(tmp_path):
    config = WorldConfig(scene=written(tmp_path, SCENE, "Scene"))
    worlds = WorldBatch(config, 4000)
    worlds.reset()
    counts = np.bincount(worlds.state.learner, minlength=20)
    assert counts.min() > 130 and counts.sum() == 4000


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("north", "method must be one of: sensor, in, out; or FILE.py:CLASS; not 'north'"),
        ("mine.py", "or FILE.py:CLASS"),
        ("nowhere.py:Mine", "nowhere.py cannot be read"),
        ("nowhere.py:sensor", "sensor is taken"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused(name, words):
    with pytest.raises(ConfigError, match=words):
        WorldConfig(method=name)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("class Other:\n    pass\n", "mine.py has no class Mine that derives from Method"),
        ("class Mine:\n    pass\n", "mine.py has no class Mine that derives from Method"),
        ("class Mine(\n", "mine.py, line 1: SyntaxError"),
        ("import numpy\nimport no_such_package\n", "mine.py, line 2: ModuleNotFoundError"),
        ("x = 1\n\nx.y\n", "mine.py, line 3: AttributeError"),
    ],
)
def test_a_file_that_is_no_method_is_refused(tmp_path, text, words):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(ConfigError, match=words):
        WorldConfig(method=f"{tmp_path / 'mine.py'}:Mine")


NAMES = '@classmethod\ndef observation_names(cls, config):\n    return ("x", "y")\n'
BROKEN_METHODS = {
    "raises": (
        NAMES + "def observe(self, state):\n    return state.nothing",
        r"mine.py, line 11: observe of Mine raised Attr",
    ),
    "wrong shape": (
        NAMES + "def observe(self, state):\n    return np.zeros((3, 3))",
        r"mine.py.*: observe of Mine raised Val.*shape",
    ),
    "NaN": (
        NAMES + "def observe(self, state):\n    return np.full((len(state.learner), 2), np.nan)",
        r"mine.py, line 10: observe of Mine gave an observation that is not finite",
    ),
    "nothing": (NAMES, r"mine.py: observe of Mine raised NotImplementedError: Mine must define observe"),
    "no names": ("def observe(self, state):\n    return 0", r"observation_names"),
    "reward": (
        NAMES + "def observe(self, state):\n    return np.zeros((len(state.learner), 2))\n"
        "def reward(self, state, mask, outcome, out):\n    out[:] = np.inf",
        r"mine.py, line 12: reward of Mine gave a reward that is not finite",
    ),
    "outcome": (
        NAMES + "def observe(self, state):\n    return np.zeros((len(state.learner), 2))\n"
        "def outcome(self, state, mask, out):\n    out[:] = 9",
        r"mine.py, line 12: outcome of Mine gave \[9\]",
    ),
    "speed": (
        NAMES + "def observe(self, state):\n    return np.zeros((len(state.learner), 2))\n"
        "def velocity(self, state, action, out_x, out_y):\n    out_x[:] = 5.0",
        r"mine.py, line 12: velocity of Mine gave a speed of 5",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_METHODS)
def test_a_broken_method_is_named_by_its_file_and_line(tmp_path, kind):
    body, words = BROKEN_METHODS[kind]
    with pytest.raises(PluginError, match=words):
        rehearse(WorldConfig(method=written(tmp_path, body)))


def test_a_kernel_that_cannot_be_compiled_is_named_by_its_line(tmp_path):
    text = """
    from sim_core.jit import kernel
    from sim_core.methods.base import Method

    @kernel
    def look(state, out):
        out[0, 0] = state.no_such_array[0]

    class Mine(Method):
        @classmethod
        def observation_names(cls, config):
            return ("x",)

        def perceive(self, state, mask, out):
            look(state, out)
    """
    (tmp_path / "mine.py").write_text(textwrap.dedent(text))
    with pytest.raises(PluginError, match=r"mine.py, line 7: perceive of Mine raised TypingError"):
        rehearse(WorldConfig(method=f"{tmp_path / 'mine.py'}:Mine"))


BROKEN_SCENES = {
    "raises": (
        "def place(self, uniform):\n    return 1 / 0",
        r"mine.py, line 8: place of Mine raised ZeroDivisionError",
    ),
    "shape": (
        "def place(self, uniform):\n    return Start(np.zeros((3, 2)), np.zeros((2, 2)))",
        r"place of Mine raised ValueError: position has the shape \(3, 2\), not \(20, 2\)",
    ),
    "overlap": (
        "def place(self, uniform):\n    return Start(np.zeros((20, 2)), np.zeros((2, 2)))",
        r"mine.py, line 7: place of Mine put robots 0 and 1 0 m apart",
    ),
    "learner": (SCENE.replace("-9.0]])", "-9.0]]), 20"), r"gave a learning robot that is none of 0..19"),
    "NaN": (SCENE.replace("* 0.5", "* np.nan"), r"gave a position or goal that is not finite"),
    "sizes": (
        SCENE + "\n@classmethod\ndef group_sizes(cls, config):\n    return (5,)",
        r"scene Mine must have groups \(2\) sizes of at least 2 robots, not \(5,\)",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_SCENES)
def test_a_broken_scene_is_named_by_its_file_and_line(tmp_path, kind):
    body, words = BROKEN_SCENES[kind]
    with pytest.raises(ConfigError, match=words):
        rehearse(WorldConfig(scene=written(tmp_path, body, "Scene")))
