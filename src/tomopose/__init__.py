"""tomopose: pose calibration for X-ray tomography.

From radiographs of one ball on a 6-DOF manipulator to projection matrices of any 3D scan trajectory, with uncertainty.
The public names are listed in `__init__.pyi`; each is imported when it is first used, so that `import tomopose` stays
light.
"""

from __future__ import annotations

from pathlib import Path as _Path

import lazy_loader

from tomopose.kernel_cache import choose_cache_folder as _choose_cache_folder

_choose_cache_folder(_Path(__file__).parent)
_load, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from tomopose.provenance import package_version

        return package_version()
    if name not in __all__:
        raise AttributeError(f"module 'tomopose' has no attribute {name!r}")
    return _load(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
