"""Scene files: what may stand in them, and the objects that they stand for."""

from .scene_file import (
    DesignTask as DesignTask,
    MonteCarloTask as MonteCarloTask,
    SceneError as SceneError,
    SceneFile as SceneFile,
    SimulateTask as SimulateTask,
    load_scene as load_scene,
    save_scene as save_scene,
)
from .traced import traced as traced
