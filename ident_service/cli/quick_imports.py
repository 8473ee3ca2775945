"""Load the libraries of one command without what it does not use.

Half of the processor time of `ident identify` was imports. Two packages of scipy load all of their modules, and those a
tenth of all modules, of which estimates use LAPACK and one distribution.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any

_COLLECT_AFTER = 200_000  # objects more than before; Python's own 700 are for programs that make few that stay
_NO_PLUGINS = {"PYDANTIC_DISABLE_PLUGINS": "__all__"}  # pydantic reads what every installed package says to find them

_PARTLY = ("scipy.linalg", "scipy.special")  # Clarabel and estimates take LAPACK of the one, Student's t of the other


class _Package(ModuleType):
    """Package whose modules load by their whole names, and whose own program runs when another name is asked for."""

    def __getattr__(self, name: str) -> Any:
        """Return a compiled function of scipy.special, or else load the package as usual."""
        if name.startswith("_") and name != "__all__":
            # `from package import _module` then loads that module, alone.
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name, obj=self)
        if self.__name__ == "scipy.special":
            from scipy.special import _ufuncs

            if name in vars(_ufuncs):
                return vars(_ufuncs)[name]
        self.__class__ = ModuleType  # type: ignore[assignment]  # from here on as any other
        if self.__spec__ is not None and self.__spec__.loader is not None:
            self.__spec__.loader.exec_module(self)
        return getattr(self, name)


@contextmanager
def quick_imports() -> Iterator[None]:
    """Load parts of packages as they are asked for, and look for garbage hardly ever, while a command runs.

    Modules make objects that stay, and looks at them are a twentieth of the time.
    """
    for name in _PARTLY:
        if name not in sys.modules and (spec := find_spec(name)) is not None:
            package = module_from_spec(spec)
            package.__class__ = _Package
            sys.modules[name] = package
            parent, _, last = name.rpartition(".")
            setattr(sys.modules[parent], last, package)
    plugins = {name: os.environ.get(name) for name in _NO_PLUGINS}
    os.environ.update(_NO_PLUGINS)
    atexit.register(gc.freeze)  # nor when the process ends
    usual = gc.get_threshold()
    gc.set_threshold(_COLLECT_AFTER, *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)
        for name, value in plugins.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
