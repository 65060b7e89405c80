"""The command line: `nonholo VERB SCENE.toml`."""

from ._cli.main import main as main
