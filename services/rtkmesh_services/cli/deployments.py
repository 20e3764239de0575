"""Finding a deployment of this host by what people call it: its file, its name, or the name of its folder."""

from pathlib import Path

from rtkmesh_services.control.registry import DeploymentFolder, Running, all_folders
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.words import clip, nearest

Known = tuple[DeploymentFolder, Running]


def known_deployments() -> list[Known]:
    """Return all deployments that this host knows."""
    return [(folder, folder.running()) for folder in all_folders()]


def is_up(known: Known) -> bool:
    """Whether a deployment has a control or running processes."""
    folder, running = known
    return folder.is_held() or bool(running.alive)


def find(name: str, among: list[Known]) -> Known:
    """Return the deployment of that name or file, without a name the only one; ServiceError names those that there are."""
    found = [known for known in among if _is_called(known, name)] if name else among
    if len(found) == 1:
        return found[0]
    names = [folder.folder.name for folder, _ in (found or among)]
    if not names:
        raise ServiceError("no deployment is up on this host")
    there = f"there are {', '.join(names)}"
    if found:
        raise ServiceError(f"{f'{clip(name)!r} is the name of several' if name else 'say which deployment'}: {there}")
    called = sorted({running.name for _, running in among} | set(names))
    raise ServiceError(f"no deployment {clip(name)!r}{nearest(name, called) or f'; {there}'}")


def _is_called(known: Known, name: str) -> bool:
    folder, running = known
    return name in (folder.folder.name, running.name) or Path(name).resolve() == Path(running.file)
