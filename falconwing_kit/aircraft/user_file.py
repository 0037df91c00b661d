"""A user's Python file -> its EFFECTS or TERMS, each checked on a small probe flow before it flies.

The file is code: it runs with the rights of the user. `CODE_NOTICE` says so; a caller prints it.
"""

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import decode_source, module_from_spec, spec_from_loader
from pathlib import Path
from string import Formatter
from typing import Any, NoReturn

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.model import FORMS, Form, Model, parameter_record
from falconwing_kit.aircraft.sparse import SPARSE_EFFECTS
from falconwing_kit.aircraft.terms import UNIFORM_WIND, Parameter, Term, WindTerm, air_flow
from falconwing_kit.core.checks import Array, InputError

CODE_NOTICE = (
    "{file} is a program: it runs now, with all your rights; use only files that you trust"
)

HOOKS = ("loads", "loads_of", "wind_field", "command_map", "input_map", "measurement_map")
ROWS, COLUMNS = 5, 3  # of the probe flow: points in time, sets of parameter values


def load_effects(path: str | Path, catalogue: Sequence[Effect] = CATALOGUE) -> tuple[Effect, ...]:
    """Run a Python file and check its list EFFECTS against a catalogue.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file or an effect in it is wrong; the text names file and line.
    """
    source = _Source.read(path)
    effects = source.take("EFFECTS", (Effect,))
    _check_effects(effects, catalogue, source)
    return tuple(effects)


def load_terms(path: str | Path, form: Form = "rates") -> tuple[Term | WindTerm, ...]:
    """Run a Python file and check its list TERMS against the model of this form.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file or a term in it is wrong; the text names file and line.
    """
    source = _Source.read(path)
    terms = source.take("TERMS", (Term, WindTerm))
    _check_terms(terms, form, source)
    return tuple(terms)


def require_effects(effects: Sequence[Effect], catalogue: Sequence[Effect] = CATALOGUE) -> None:
    """Raise InputError unless the effects can be tried beside this catalogue."""
    source = _Source()
    for effect in effects:
        if not isinstance(effect, Effect):
            source.refuse("effects", f"expected Effect objects, got {effect!r}")
    _check_effects(effects, catalogue, source)


# The file


@dataclass(frozen=True)
class _Source:
    """The text that a definition stands in; empty where it was made in Python."""

    path: Path | None = None
    text: str = ""

    @classmethod
    def read(cls, path: str | Path) -> "_Source":
        """A file whose text parses."""
        path = Path(path)
        try:
            data = path.read_bytes()
        except IsADirectoryError:
            raise InputError(f"{path}: expected a Python file, got a folder") from None
        try:
            source = cls(path, decode_source(data))
            ast.parse(source.text, str(path))
        except (SyntaxError, ValueError) as error:
            line = getattr(error, "lineno", None) or 1
            got = getattr(error, "msg", error)
            raise InputError(
                f"{path.name}, line {line}: expected Python, got {got}: correct this line"
            ) from None
        return source

    def refuse(self, near: Any, problem: str) -> NoReturn:
        """Raise InputError with file and line of a function, an exception or a quoted name."""
        where = f"{self.path.name}, line {self.line(near)}: " if self.path else ""
        raise InputError(f"{where}{problem}") from None

    def line(self, near: Any) -> int:
        """Line of an exception's last step in this file, of a function, or of a quoted name."""
        if isinstance(near, BaseException):
            trace, line = near.__traceback__, 1
            while trace is not None:
                if trace.tb_frame.f_code.co_filename == str(self.path):
                    line = trace.tb_lineno
                trace = trace.tb_next
            return line
        code = getattr(near, "__code__", None)
        if code is not None and code.co_filename == str(self.path):
            return int(code.co_firstlineno)
        for node in ast.walk(ast.parse(self.text)):
            names = (
                {getattr(node, "value", None), getattr(node, "id", None)} if _hashable(node) else ()
            )
            if near in names:
                return int(getattr(node, "lineno", 1))
        return 1

    def take(self, name: str, kinds: tuple[type, ...]) -> list[Any]:
        """Run the file and return its list of this name.

        Raises:
            InputError: it raises, has no such list, or the list holds something else.
        """
        spec = spec_from_loader("user_file", loader=None, origin=str(self.path))
        assert spec is not None
        module = module_from_spec(spec)
        module.__file__ = str(self.path)
        try:
            exec(compile(self.text, str(self.path), "exec"), module.__dict__)
        except (Exception, SystemExit) as error:
            self.refuse(error, f"expected a file that runs, got {_error_text(error)}: correct it")
        expected = " or ".join(kind.__name__ for kind in kinds)
        found = getattr(module, name, None)
        if found is None:
            self.refuse(name, f"expected {name} = [{expected}(...)], got no {name}: add it")
        if not isinstance(found, list | tuple) or not found:
            self.refuse(
                name, f"{name}: expected a list of {expected}, got {found!r:.60}: write one"
            )
        for item in found:
            if not isinstance(item, kinds):
                self.refuse(
                    name, f"{name}: expected {expected} objects, got {item!r:.60}: write one"
                )
        return list(found)


def _hashable(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__} ({error})" if str(error) else type(error).__name__


# What a definition must be


def _check_effects(effects: Sequence[Effect], catalogue: Sequence[Effect], source: _Source) -> None:
    known = (
        {e.name for e in (*catalogue, *GENERIC_EFFECTS, *SPARSE_EFFECTS)} | _term_names() | {"none"}
    )
    taken = {p.name for e in (*catalogue, *GENERIC_EFFECTS, *SPARSE_EFFECTS) for p in e.parameters}
    taken |= {p.name for form in FORMS.values() for p in form().parameters}
    for effect in effects:
        _check_name("effect", effect.name, known, source)
        _check_parameters(effect.name, effect.parameters, taken, source)
        _check_fields(effect, {e.name for e in (*catalogue, *effects)}, source)
        if not effect.same_as:
            _probe_effect(effect, source)
        _check_draw(effect, (*catalogue, *effects), source)
        taken |= {p.name for p in effect.parameters}


def _check_terms(terms: Sequence[Term | WindTerm], form: Form, source: _Source) -> None:
    model = FORMS[form]()
    known, taken = _term_names() | {e.name for e in CATALOGUE}, set(model.names)
    for term in terms:
        _check_name("term", term.name, known, source)
        _check_parameters(term.name, term.parameters, taken, source)
        _probe_term(model.with_terms(term), term, term.parameters, term.evaluate, source)
        known |= {term.name}
        taken |= {p.name for p in term.parameters}


def _term_names() -> set[str]:
    return {t.name for form in FORMS.values() for t in form().terms} | {UNIFORM_WIND.name}


def _check_name(what: str, name: Any, known: set[str], source: _Source) -> None:
    if not isinstance(name, str) or not name or "+" in name or not name.isprintable():
        source.refuse(name, f"{what} name: expected a word, got {name!r}: choose one")
    if name in known:
        source.refuse(name, f"{what} {name!r}: expected a new name, got one of the kit: rename it")


def _check_parameters(owner: str, parameters: Any, taken: set[str], source: _Source) -> None:
    if not isinstance(parameters, tuple) or not all(isinstance(p, Parameter) for p in parameters):
        source.refuse(
            owner, f"{owner}: parameters: expected a tuple of Parameter, got {parameters!r:.60}"
        )
    names = [p.name for p in parameters]
    for p in parameters:
        if not isinstance(p.name, str) or not p.name.isidentifier() or p.name.startswith("_"):
            source.refuse(
                p.name, f"{owner}: parameter name: expected one like my_size, got {p.name!r}"
            )
        if p.name in taken or names.count(p.name) > 1:
            source.refuse(
                p.name,
                f"{owner}: parameter {p.name!r}: expected a new name, got one in use: rename it",
            )
        numbers = (p.low, p.start, p.high)
        finite = all(isinstance(v, int | float) and np.isfinite(v) for v in numbers)
        if not finite or not p.low <= p.start <= p.high or p.low == p.high:
            source.refuse(
                p.name,
                f"{owner}: parameter {p.name!r}: expected low <= start <= high, got {p.low!r}, "
                f"{p.start!r}, {p.high!r}: correct them",
            )


def _check_fields(effect: Effect, known: set[str], source: _Source) -> None:
    """Hooks, names of parameters and effects, and bounds that contain the absent effect."""
    name, own = effect.name, {p.name for p in effect.parameters}
    hooks = [hook for hook in HOOKS if getattr(effect, hook) is not None]
    for hook in hooks:
        if not callable(getattr(effect, hook)):
            source.refuse(name, f"effect {name!r}: {hook}: expected a function: give one")
    if effect.same_as:
        if hooks or own or effect.same_as not in known:
            source.refuse(
                name,
                f"effect {name!r}: same_as: expected another effect's name, no hook and no "
                f"parameters, got {effect.same_as!r}: correct it",
            )
    elif len(hooks) != 1:
        source.refuse(
            name,
            f"effect {name!r}: expected exactly one of {', '.join(HOOKS)}, got "
            f"{' and '.join(hooks) or 'none'}: give one",
        )
    if effect.equation and _placeholders(effect.equation) != own:
        source.refuse(
            name,
            f"effect {name!r}: equation: expected each of its parameters in braces and nothing "
            f"else in them ({{{'}, {'.join(p.name for p in effect.parameters)}}}), got "
            f"{effect.equation!r:.60}: correct it",
        )
    used = {*effect.shape, *effect.essential, *(effect.place or ())}
    used |= {key for start in effect.starts for key in start}
    if unknown := used - own:
        source.refuse(
            name, f"effect {name!r}: expected its own parameters, got {min(unknown)!r}: correct it"
        )
    if unknown := set(effect.contains) - known:
        source.refuse(
            name,
            f"effect {name!r}: contains: expected effects' names, got {min(unknown)!r}: correct it",
        )
    if effect.frozen_number is not None:
        source.refuse(
            name, f"effect {name!r}: frozen_number: expected None outside the kit: remove it"
        )
    for p in effect.amplitudes:
        if p.start == 0.0 or not p.low <= 0.0 <= p.high:
            source.refuse(
                p.name,
                f"effect {name!r}: parameter {p.name!r}: expected bounds that contain 0 "
                f"and a start other than 0, got {p.low:g} to {p.high:g} and {p.start:g}: "
                "correct them or list it in shape",
            )
    if not effect.same_as and not effect.amplitudes:
        source.refuse(
            name, f"effect {name!r}: expected a parameter that is zero when it is absent, got none"
        )


def _placeholders(equation: str) -> set[str]:
    """The names in braces of an equation; empty where the braces do not match."""
    try:
        parts = list(Formatter().parse(equation))
    except (TypeError, ValueError):
        return set()
    return {
        f"{name}{':' if form else ''}{'!' if conversion else ''}"
        for _, name, form, conversion in parts
        if name is not None
    }


# What a hook returns


@dataclass(frozen=True)
class _Hook:
    """One call of a user's function whose result is checked part by part."""

    owner: str
    name: str
    user_function: Callable[..., Any]
    source: _Source

    def call(self, *arguments: Any) -> Any:
        """The result, or InputError with the line that raised."""
        try:
            with np.errstate(all="ignore"):
                return self.user_function(*arguments)
        except Exception as error:
            self.source.refuse(
                error if self._is_own(error) else self.user_function,
                f"{self.owner}: {self.name}: expected a result on the probe flow, got "
                f"{_error_text(error)}: use NumPy on numbers and arrays alike",
            )

    def _is_own(self, error: BaseException) -> bool:
        return self.source.path is not None and self.source.line(error) > 1

    def parts(self, result: Any, count: int, shape: tuple[int, ...], what: str) -> Array:
        """(count, *shape) of finite numbers."""
        try:
            found = [np.asarray(part, np.float64) for part in result]
            assert len(found) == count
            array = np.stack([np.broadcast_to(part, shape) for part in found])
        except Exception:
            shapes = (
                [np.shape(part) for part in result]
                if isinstance(result, tuple | list)
                else f"shape {np.shape(result)}"
            )
            self.refuse(f"expected {what}, each a number or of shape {shape}", f"{shapes}")
        if not np.isfinite(array).all():
            self.refuse(f"expected finite {what}", "nan or inf on an ordinary flow")
        return array

    def refuse(self, expected: str, got: str) -> NoReturn:
        """Raise InputError at the function."""
        self.source.refuse(
            self.user_function, f"{self.owner}: {self.name}: {expected}, got {got}: correct it"
        )


def _probe_values(model: Model, parameters: Sequence[Parameter], absent: set[str]) -> Any:
    """Record K whose own fields are (COLUMNS, 1): at the start, 10 % off, and absent."""
    own = {
        p.name: np.array([p.start, _inside(p, 1.1 * p.start), 0.0 if p.name in absent else p.start])
        for p in parameters
    }
    return parameter_record(model.names)(
        *(own[n][:, None] if n in own else float(model.values[n]) for n in model.names)
    )


def _inside(p: Parameter, value: float) -> float:
    return float(np.clip(value, p.low, p.high))


def _probe_term(
    model: Model,
    owner: Any,
    parameters: Sequence[Parameter],
    function: Any,
    source: _Source,
    absent: set[str] | None = None,
) -> None:
    """Force, moment or wind: right shapes and finite on arrays and numbers, zero where absent."""
    rng, shape = np.random.default_rng(1), (COLUMNS, ROWS)
    velocity = rng.uniform([[5.0], [-1.0], [-0.5]], [[9.0], [1.0], [1.5]], (3, ROWS))
    place = rng.uniform([[-8.0], [-5.0], [0.3]], [[8.0], [5.0], [3.0]], (3, ROWS))
    rates, time = rng.normal(size=(3, ROWS)), np.linspace(0.0, 60.0, ROWS)
    commands = rng.uniform([[0.1], [-1.0], [-1.0], [-1.0]], 1.0, (4, ROWS))
    blows = isinstance(owner, WindTerm)
    hook = _Hook(f"{owner.name!r}", "wind_field" if blows else "loads", function, source)
    count, what = (3, "three wind components") if blows else (6, "six loads (force, moment)")

    K = _probe_values(model, parameters, absent or set())
    flow = (*place, time) if blows else (air_flow(velocity, rates, place, time, commands),)
    result = hook.parts(hook.call(*flow, K), count, shape, what)
    if absent and np.abs(result[:, -1]).max() > 1e-9:
        hook.refuse(
            "expected zero where its amplitudes are zero", f"{np.abs(result[:, -1]).max():.3g}"
        )
    numbers = model.K
    at = [v[:, 0].tolist() for v in (velocity, rates, place, commands)]
    flow = (*at[2], 0.0) if blows else (air_flow(at[0], at[1], at[2], 0.0, at[3]),)
    hook.parts(hook.call(*flow, numbers), count, (), what)


def _probe_effect(effect: Effect, source: _Source) -> None:
    """Call the effect's hook and its scan on a small flow."""
    model = FORMS["rates"]()
    absent = {p.name for p in effect.amplitudes}
    if effect.loads_of is not None:
        hook = _Hook(f"{effect.name!r}", "loads_of", effect.loads_of, source)
        if not callable(hook.call(model.terms)):
            hook.refuse("expected a function (air, K) -> loads", "something else")
    model = model.with_effect(effect)
    if effect.changes_flow:
        term = effect.wind_term or effect.term(FORMS["rates"]().terms)
        assert term is not None
        _probe_term(model, term, effect.parameters, term.evaluate, source, absent)
    else:
        _probe_maps(model, effect, absent, source)
    if effect.scan_points is not None:
        hook = _Hook(f"{effect.name!r}", "scan_points", effect.scan_points, source)
        points = hook.call(np.array([-6.0, -4.0]), np.array([6.0, 4.0]))
        own = {p.name for p in effect.parameters}
        if not points or any(not isinstance(p, dict) or set(p) - own for p in points):
            hook.refuse("expected a list of {parameter: value}", f"{points!r:.60}")


def _probe_maps(model: Model, effect: Effect, absent: set[str], source: _Source) -> None:
    """Input and measurement maps: shapes kept, finite, and nothing changed where absent."""
    rng = np.random.default_rng(2)
    present = model.K
    without = model.with_values(dict.fromkeys(absent, 0.0)).K
    t, commands = 0.05 * np.arange(ROWS), rng.uniform(0.0, 1.0, (ROWS, 4))
    if effect.command_map is not None:
        hook = _Hook(f"{effect.name!r}", "command_map", effect.command_map, source)
        results = [hook.call(t, commands.copy(), K) for K in (present, without)]
        for result in results:
            if np.shape(result) != commands.shape or not np.isfinite(result).all():
                hook.refuse(
                    f"expected finite commands of shape {commands.shape}", _shape_text(result)
                )
        hook.call(t[:1], commands[:1], present)
        if np.abs(results[1] - commands).max() > 1e-9:
            hook.refuse("expected the commands unchanged at zero amplitude", "others")
    if effect.input_map is not None:
        hook = _Hook(f"{effect.name!r}", "input_map", effect.input_map, source)
        what = "three times in s (delay, lag, lag in series)"
        hook.parts(hook.call(present), 3, (), what)
        if np.any(hook.parts(hook.call(without), 3, (), what)):
            hook.refuse("expected (0, 0, 0) at zero amplitude", "other times")
    if effect.measurement_map is not None:
        hook = _Hook(f"{effect.name!r}", "measurement_map", effect.measurement_map, source)
        pose = rng.uniform(-0.5, 0.5, (6, 2, COLUMNS, ROWS))
        K = _probe_values(model, effect.parameters, absent)
        result = hook.call(pose.copy(), K)
        if np.shape(result) != pose.shape or not np.isfinite(result).all():
            hook.refuse(f"expected finite poses of shape {pose.shape}", _shape_text(result))
        if np.abs(result[:, :, -1] - pose[:, :, -1]).max() > 1e-9:
            hook.refuse("expected the poses unchanged at zero amplitude", "others")


def _shape_text(result: Any) -> str:
    shape = np.shape(result)
    return f"shape {shape}" + (" with nan or inf" if np.size(result) and shape else "")


def _check_draw(effect: Effect, catalogue: Sequence[Effect], source: _Source) -> None:
    """Sizes in rising order, and a draw that gives every parameter of one form of the effect."""
    if effect.sizes is None and effect.draw is None:
        return
    hook = _Hook(f"{effect.name!r}", "draw", effect.draw or dict, source)
    sizes = effect.sizes
    if (
        effect.draw is None
        or sizes is None
        or len(sizes) != 3
        or not 0.0 < min(sizes) <= max(sizes) < np.inf
    ):
        source.refuse(
            effect.name,
            f"effect {effect.name!r}: expected three sizes above 0 (just visible at marker noise, "
            f"at pose-net noise, plainly visible) and a function draw, got {sizes!r}: give both",
        )
        return
    drawn = hook.call(np.random.default_rng(3), float(sizes[2]))
    forms = [e for e in catalogue if e.name == (effect.same_as or effect.name)]
    if not isinstance(drawn, dict) or not any(
        set(drawn) == {p.name for p in form.parameters} for form in forms
    ):
        hook.refuse("expected {parameter: value} for all of its parameters", f"{drawn!r:.60}")
    if not np.isfinite(list(drawn.values())).all():
        hook.refuse("expected finite values", f"{drawn!r:.60}")
