"""Scenes: where robots start and what their goals are."""

from __future__ import annotations

from sim_core.config import WorldConfig
from sim_core.plugins import SCENES
from sim_core.scenes.base import CheckedScene, Scene


def make_scene(config: WorldConfig) -> Scene:
    """The scene that `config.scene` names; a user's own is checked whenever it is asked."""
    if config.source(SCENES):
        return CheckedScene(config)
    scene: Scene = config.scene_class(config)
    return scene
