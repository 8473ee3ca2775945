"""Load and call `constraints.custom` of a description: a Python function that adds what no schema foresees.

The function gets the link and base parameters as cvxpy expressions in SI units and returns cvxpy constraints, or these
and a convex penalty. It is code of the machine that identifies; nothing else that reads a description runs it.
"""

from __future__ import annotations

import hashlib
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ident_service.errors import ParameterError

if TYPE_CHECKING:
    import cvxpy as cp

_WANTED = "return a list of cvxpy constraints, or a pair of such a list and a convex penalty"


class CustomError(ParameterError):
    """Report that `constraints.custom` cannot be imported or called, or returns something that is not convex."""


@dataclass(frozen=True)
class CustomFunction:
    """Python function that a description names in `constraints.custom`.

    Attributes:
        name: `module:function`.
        file: name of the file that the module was read from, without its folder.
        sha256: of the file.
        function: function from link and base parameters, by name, to constraints.
    """

    name: str
    file: str
    sha256: str
    function: Callable[[Mapping[str, cp.Expression], Mapping[str, cp.Expression]], object]

    def constraints(
        self, link_parameters: Mapping[str, cp.Expression], base_parameters: Mapping[str, cp.Expression]
    ) -> tuple[list[cp.Constraint], cp.Expression | None]:
        """Call the user's function; return its constraints, checked to be convex, and its penalty or None.

        Args:
            link_parameters: link parameters in SI units by their names (`m7`).
            base_parameters: base parameters in SI units by their expressions, as `ident base-parameters` prints them.

        Raises:
            CustomError: the function raises, or returns something else or something that is not convex.
        """
        import cvxpy as cp

        try:
            returned = self.function(MappingProxyType(dict(link_parameters)), MappingProxyType(dict(base_parameters)))
        except Exception as error:
            raise CustomError(f"{self.name} raised {_error_words(error, self.file)}") from error
        penalty: Any = None
        if isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[0], list | tuple):
            returned, penalty = returned
        if not isinstance(returned, list | tuple):
            raise CustomError(f"{self.name} returned {_kind(returned)}; {_WANTED}")
        for number, constraint in enumerate(returned, 1):
            if not isinstance(constraint, cp.Constraint):
                raise CustomError(f"constraint {number} of {self.name} is {_kind(constraint)}; {_WANTED}")
            if not constraint.is_dcp():
                raise CustomError(
                    f"constraint {number} of {self.name} is not convex by cvxpy's rules (DCP): {_short(constraint)}"
                )
        if penalty is not None:
            self._check_penalty(penalty)
        parts = [*returned, *([] if penalty is None else [penalty])]
        if any(one.attributes["boolean"] or one.attributes["integer"] for part in parts for one in part.variables()):
            raise CustomError(f"{self.name} uses integer variables, which make the problem not convex; leave them out")
        if any(part.parameters() for part in parts):
            raise CustomError(f"{self.name} uses a cvxpy Parameter, which nobody gives a value; use a number")
        return list(returned), penalty

    def _check_penalty(self, penalty: Any) -> None:
        import cvxpy as cp

        if not isinstance(penalty, cp.Expression):
            raise CustomError(f"the penalty of {self.name} is {_kind(penalty)}; {_WANTED}")
        if not penalty.is_scalar():
            raise CustomError(f"the penalty of {self.name} has the shape {penalty.shape}; return one number")
        if not (penalty.is_convex() and penalty.is_dcp()):
            raise CustomError(f"the penalty of {self.name} is not convex by cvxpy's rules (DCP): {_short(penalty)}")


def load_custom(function_name: str, folder: Path) -> CustomFunction:
    """Import the function `module:function` that a description names; raises CustomError if that fails.

    Args:
        function_name: `module:function`.
        folder: of the description, where the module is looked for after `sys.path` (so after PYTHONPATH).

    Raises:
        CustomError: there is no such module or function, or the module raises while it is imported.
    """
    module, function = function_name.split(":")
    file = f"{module.split('.')[0]}.py"
    try:
        with _importable(folder):
            found = EntryPoint(name=function, value=function_name, group="ident_service.custom").load()
    except AttributeError as error:
        if module in sys.modules and not hasattr(sys.modules[module], function):
            raise CustomError(f"the module {module!r} has no function {function!r}") from None
        raise CustomError(f"importing {module!r} raised {_error_words(error, file)}") from error
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(f"{error.name}.")):
            raise CustomError(
                f"there is no module {module!r}; put {file} beside the description, or its folder into PYTHONPATH"
            ) from None
        raise CustomError(f"importing {module!r} raised {_error_words(error, file)}") from error
    except (Exception, SystemExit) as error:
        raise CustomError(f"importing {module!r} raised {_error_words(error, file)}") from error
    if not callable(found):
        raise CustomError(f"{function_name} is {_kind(found)}, not a function")
    source = getattr(sys.modules[module], "__file__", None)
    if source is None:
        raise CustomError(f"the module {module!r} is no file, so that a result could not name what it was made with")
    return CustomFunction(
        function_name, Path(source).name, hashlib.sha256(Path(source).read_bytes()).hexdigest(), found
    )


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    # Last, so that a file beside a description hides no library.
    path = str(folder.resolve())
    sys.path.append(path)
    try:
        yield
    finally:
        sys.path.remove(path)


def _error_words(error: BaseException, file: str) -> str:
    """Format an error in one line, with the last line of the user's own file that led to it."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).name == file]
    place = f" ({file}, line {frames[-1].lineno})" if frames else ""
    text = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}{': ' if text else ''}{text}{place}"


def _kind(value: object) -> str:
    return "None" if value is None else f"of the type {type(value).__name__}"


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 200 else f"{text[:197]}..."
