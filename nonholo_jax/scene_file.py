"""Scene files: a ball, surfaces, a throw and what to do with it, as one TOML file."""

from ._files import (
    DesignTask as DesignTask,
    MonteCarloTask as MonteCarloTask,
    SceneError as SceneError,
    SceneFile as SceneFile,
    SimulateTask as SimulateTask,
    load_scene as load_scene,
    save_scene as save_scene,
    traced as traced,
)
