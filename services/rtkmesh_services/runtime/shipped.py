"""The files that we ship: deployments and receiver recipes, in the installed package or in the checkout."""

from pathlib import Path

import rtkmesh_services
from rtkmesh_schemas.errors import ConfigError


def config_path(name: str) -> Path:
    """Return a file that we ship; ConfigError where there is none."""
    for folder in config_folders():
        if (folder / name).is_file():
            return folder / name
    raise ConfigError(name, None, "not found in the package")


def config_folders() -> tuple[Path, Path]:
    """Return where shipped files may be: of the installed package, of the checkout."""
    package = Path(rtkmesh_services.__file__).parent
    return package / "config", package.parents[1] / "config"
