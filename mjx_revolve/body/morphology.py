"""The tree of modules: read, checked, laid out at rest, described and written.

A morphology file is Revolve's YAML: `id`, `body` (a tree of modules, each with `id`, `type`,
`orientation`, `params` and `children` by slot) and `brain`. The core's frame is the robot's: at the
origin, unturned. All positions are in that frame, at rest (hinges at 0), in metres.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.descriptors import describe
from mjx_revolve.body.module_types import ModuleType, Part, Vector, check_number, show
from mjx_revolve.body.params import apply_overrides, check_overrides, read_number
from mjx_revolve.body.placement import Module, attach, find_bounds, find_overlaps, frozen, same
from mjx_revolve.inputs.errors import InputError, SafeLoader, load_yaml
from mjx_revolve.inputs.shipped import find_shipped

__all__ = ["Module", "Morphology", "load_morphology", "save_morphology", "trim_neutral"]

# Evolved robots have about 30 modules. The limit is a choice: it keeps a mistake from taking hours.
MAX_MODULES = 1000

# Names that the MuJoCo model keeps for itself.
_RESERVED = ("world", "root")

_MODULE_KEYS = ("id", "type", "slot", "orientation", "params", "children")
_COLORS = ("red", "green", "blue")


# ------------------------------------------------------------------------- values


@dataclass(frozen=True, eq=False)
class Morphology:
    """A robot's body as a tree of modules, depth first in the file's order.

    Two morphologies are equal when name, modules and brain are.

    Attributes:
        name: the file's `id`, or its stem.
        modules: the core first; a parent comes before its children.
        brain: the file's `brain` as it is, for whoever understands it; None where there is none.
        path: the file that it was read from.
        overlaps: names of the pairs of modules that overlap at rest (empty unless allowed).
    """

    name: str
    modules: tuple[Module, ...]
    brain: Any = None
    path: str | None = None
    overlaps: tuple[tuple[str, str], ...] = ()

    def __eq__(self, other: object) -> bool:
        """Same name, modules and brain; the path does not count."""
        if not isinstance(other, Morphology):
            return NotImplemented
        return (
            self.name == other.name
            and self.modules == other.modules
            and same(self.brain, other.brain)
        )

    @property
    def num_modules(self) -> int:
        """Number of modules; a hinge is one."""
        return len(self.modules)

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return sum(module.kind.mass for module in self.modules)

    @property
    def volume(self) -> float:
        """Displaced volume, electronics and ballast included [m³]."""
        return sum(module.kind.volume for module in self.modules)

    @property
    def center_of_mass(self) -> np.ndarray:
        """`[3]` centre of mass at rest, core frame [m]."""
        return self._center(lambda part: (part.total_mass, part.center_of_mass))

    @property
    def center_of_volume(self) -> np.ndarray:
        """`[3]` centre of the displaced volume at rest, core frame [m].

        Where it lies above the centre of mass, the robot rights itself under water.
        """
        return self._center(lambda part: (part.total_volume, part.displaced_center))

    def _center(self, look: Callable[[Part], tuple[float, Vector]]) -> np.ndarray:
        """Weighted mean of a point of each part; `look` gives weight and point, part frame."""
        center, whole = np.zeros(3), 0.0
        for module in self.modules:
            for part in module.kind.parts:
                weight, point = look(part)
                place = module.rotation @ np.add(part.position, point)
                center += weight * (module.position + place)
                whole += weight
        return center / whole if whole > 0.0 else center

    @property
    def box_volume(self) -> float:
        """Sum of all collision boxes' volumes [m³]; shared space counts for each box."""
        return sum(module.kind.box_volume for module in self.modules)

    @property
    def hinges(self) -> tuple[int, ...]:
        """Indices of the modules with a hinge, in order: the order of `ctrl`."""
        return tuple(i for i, m in enumerate(self.modules) if m.kind.hinge is not None)

    @property
    def num_hinges(self) -> int:
        """Number of hinges."""
        return len(self.hinges)

    @property
    def thrusters(self) -> tuple[tuple[int, int], ...]:
        """Module and part of each thruster, in order: the order of `ctrl` after the hinges'."""
        return tuple(
            (i, k)
            for i, module in enumerate(self.modules)
            for k, part in enumerate(module.kind.parts)
            if part.thruster is not None
        )

    @property
    def num_thrusters(self) -> int:
        """Number of thrusters."""
        return len(self.thrusters)

    @property
    def num_fins(self) -> int:
        """Number of modules with a fin."""
        return sum(module.kind.is_fin for module in self.modules)

    def hinge_neighbours(self) -> tuple[tuple[int, int], ...]:
        """Pairs of hinges that share a rigid body.

        Modules that are welded together are one body; a hinge joins the body that it is attached to
        and the body that it moves.

        Returns:
            pairs (i, j), i < j, of positions in `hinges`, in order.
        """
        number = {index: k for k, index in enumerate(self.hinges)}
        carries: list[int] = []  # the hinge that moves a module's children, -1 for the core's body
        joined: dict[int, list[int]] = {}
        for index, module in enumerate(self.modules):
            body = carries[module.parent] if module.parent >= 0 else -1
            if index in number:
                joined.setdefault(body, []).append(number[index])
                body = number[index]
                joined.setdefault(body, []).append(body)
            carries.append(body)
        pairs = {(min(i, j), max(i, j)) for group in joined.values() for i in group for j in group}
        return tuple(sorted((i, j) for i, j in pairs if i < j))

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`[3]` lowest and `[3]` highest corner of all boxes at rest, core frame [m]."""
        return find_bounds(self.modules)

    @property
    def extent(self) -> np.ndarray:
        """`[3]` edges of the bounding box at rest along the core's x, y, z [m]."""
        low, high = self.bounds
        return high - low

    @property
    def length(self) -> float:
        """Body length: the largest extent at rest [m]."""
        return float(self.extent.max())

    @cached_property
    def descriptors(self) -> dict[str, float]:
        """Measures of the body; see `descriptors.describe`."""
        return describe(self.modules)

    def save(self, path: str | Path) -> None:
        """Writes the morphology; see `save_morphology`."""
        save_morphology(self, path)


# ------------------------------------------------------------------------- reading


def load_morphology(
    path: str | Path,
    modules: Mapping[str, ModuleType] = MODULES,
    allow_overlap: bool = False,
) -> Morphology:
    """Reads a robot's body from Revolve's YAML.

    Read as found in the wild: slots may be numbers or text; a module's `slot` key means nothing;
    `orientation` (0), `params` and `id` may be missing (a module without id is named after its type
    and place in the order); numbers in `params` may be written like `0.707;`; the brain is kept as
    it is. Where an id repeats, or is one that MuJoCo needs, the later modules get the suffix _2,
    _3 and so on. Anything else unexpected is refused.

    `params` may hold `red`, `green`, `blue` (0 to 1, all or none) and these overrides; numbers are
    >= 0:

    - `mass` [kg] and `volume` [m³] of the whole module, shared among its parts in proportion to the
      catalogue's values (a choice);
    - `electronics_volume` [m³] of the whole module, all of it in the part with the largest volume,
      which in a hinge is the servo (a choice); `center_of_volume` of that part (three numbers, part
      frame [m]);
    - `ballast` [kg] added to the first part: to its mass, or, with `ballast_position` (three
      numbers, part frame [m]) or `ballast_volume` [m³], as a point there that takes the place of
      the part's own;
    - `drag_coefficient`, `added_mass_coefficient`, `entrained_water` (share of the box's free
      volume, 0 to 1) of every part [-];
    - `buoyancy`, `drag` (a law's name or `off`) and `added_mass` (true or false): the module's own
      choice where the world's does not suit it;
    - `lift_drag`: a mapping with fields of `LiftDrag`, such as `{cla: 2.0}`; it changes a fin and
      makes a fin of any other module;
    - `thruster`: a mapping with fields of `Thruster`, such as `{torque_ratio: -0.0035}` for a
      left-handed propeller; `thrust` [N] at its highest command, which scales its curve.

    Args:
        path: the file, or a shipped morphology's name.
        modules: the types of modules by name and alias.
        allow_overlap: load a robot whose modules overlap at rest; `overlaps` then names them.

    Returns:
        The morphology.

    Raises:
        InputError: the file cannot be read, or something in it is wrong; the message says where,
            what was expected and what was found.
    """
    path = find_shipped(path, "morphologies")
    data = load_yaml(path)
    if not isinstance(data, dict):
        found = "an empty file" if data is None else show(data)
        raise InputError(f"{path}: expected a mapping with id, body and brain; found {found}")
    _check_known(data, ("id", "body", "brain"), str(path))
    if "body" not in data:
        raise InputError(f"{path}: expected the key body; found {show(list(data))}")
    tree = _read_tree(data["body"], modules, path)
    morphology = Morphology(
        name=_read_id(data.get("id"), f"{path}: id") or path.stem,
        modules=tree,
        brain=data.get("brain"),
        path=str(path),
    )
    pairs = find_overlaps(tree)
    if pairs and not allow_overlap:
        named = ", ".join(f"{a} and {b}" for a, b in pairs[:5])
        more = f" and {len(pairs) - 5} more" if len(pairs) > 5 else ""
        raise InputError(
            f"{path}: body: expected modules that do not overlap at rest; found overlapping: "
            f"{named}{more} (allow_overlap loads them all the same)"
        )
    return replace(morphology, overlaps=pairs)


def _check_known(item: dict[Any, Any], known: tuple[str, ...], place: str) -> None:
    for key in item:
        if key not in known:
            raise InputError(f"{place}: expected only {', '.join(known)}; found {show(key)}")


def _read_tree(body: Any, modules: Mapping[str, ModuleType], path: Path) -> tuple[Module, ...]:
    """All modules, depth first, with unique names."""
    found: list[Module] = []
    stack: list[tuple[Any, str, int, int]] = [(body, "body", -1, -1)]
    while stack:
        item, where, parent, slot = stack.pop()
        place = f"{path}: {where}"
        if len(found) == MAX_MODULES:
            raise InputError(f"{path}: body: expected at most {MAX_MODULES} modules; found more")
        above = found[parent] if parent >= 0 else None
        module = _read_module(item, place, modules, above)
        index = len(found)
        found.append(replace(module, parent=parent, slot=slot))
        children = _read_children(item, place, module)
        stack.extend(
            (child, f"{where}.children.{number}", index, number)
            for number, child in reversed(children.items())
        )
        if above is not None:
            pose = attach(above, above.kind.slots[slot], module)
            found[index] = replace(found[index], position=pose[0], rotation=pose[1])
    return _with_unique_names(found)


def _read_module(
    item: Any, place: str, modules: Mapping[str, ModuleType], parent: Module | None
) -> Module:
    """One module without its children, at the origin."""
    if not isinstance(item, dict):
        found = "nothing" if item is None else show(item)
        raise InputError(f"{place}: expected a module (a mapping with a type); found {found}")
    _check_known(item, _MODULE_KEYS, place)
    kind = _read_type(item, place, modules, parent)
    orientation = _read_orientation(item.get("orientation"), f"{place}.orientation")
    if parent is None and orientation != 0.0:
        raise InputError(
            f"{place}.orientation: expected 0 (the core is attached to nothing); "
            f"found {orientation:g}"
        )
    rgb, params = _read_params(item.get("params"), f"{place}.params")
    try:
        changed = apply_overrides(kind, params)
    except InputError as error:
        raise InputError(f"{place}.params: {error}") from None
    return Module(
        name=_read_id(item.get("id"), f"{place}.id"),
        type=kind.name,
        parent=-1,
        slot=-1,
        orientation=orientation,
        rgb=rgb,
        position=frozen(np.zeros(3)),
        rotation=frozen(np.eye(3)),
        kind=changed,
        params=params,
    )


def _read_type(
    item: dict[str, Any], place: str, modules: Mapping[str, ModuleType], parent: Module | None
) -> ModuleType:
    """The type of a module, checked against where it stands."""
    names = sorted(n for n, k in modules.items() if (k.mount is None) == (parent is None))
    expected = f"expected one of {', '.join(names)}"
    if item.get("type") is None:
        raise InputError(f"{place}.type: {expected}; found none")
    name = item["type"]
    if not isinstance(name, str) or name not in modules:
        raise InputError(f"{place}.type: {expected}; found {show(name)}")
    kind = modules[name]
    if parent is None and kind.mount is not None:
        raise InputError(f"{place}.type: {expected} (the root is a core); found {name!r}")
    if parent is not None and kind.mount is None:
        raise InputError(f"{place}.type: {expected} (a core is always the root); found {name!r}")
    return kind


def _read_children(item: dict[str, Any], place: str, module: Module) -> dict[int, Any]:
    """Children by slot number, in the file's order."""
    children = item.get("children")
    if children is None:
        return {}
    place = f"{place}.children"
    if not isinstance(children, dict):
        raise InputError(
            f"{place}: expected a mapping from slots to modules; found {show(children)}"
        )
    slots = module.kind.slots
    if children and not slots:
        raise InputError(
            f"{place}: expected none, since type {module.type} has no slots; "
            f"found {show(list(children))}"
        )
    found: dict[int, Any] = {}
    for key, child in children.items():
        number = int(key) if isinstance(key, str) and re.fullmatch(r"[0-9]{1,9}", key) else key
        if not isinstance(number, int) or isinstance(number, bool) or number not in slots:
            hint = " (slot 0 is where it is attached)" if number == 0 and 0 not in slots else ""
            raise InputError(
                f"{place}: expected one of the slots {', '.join(map(str, sorted(slots)))} of type "
                f"{module.type}{hint}; found {show(key)}"
            )
        if number in found:
            raise InputError(f"{place}: expected each slot once; found slot {number} twice")
        found[number] = child
    return found


def _read_id(value: Any, place: str) -> str:
    """A name, or "" where there is none."""
    if value is None:
        return ""
    if isinstance(value, bool | dict | list):
        raise InputError(
            f"{place}: expected a name or a number (YAML reads yes, no, on, off as true or false: "
            f"put them in quotes); found {show(value)}"
        )
    try:
        return str(value)
    except ValueError:
        raise InputError(f"{place}: expected a name or a number; found {show(value)}") from None


def _read_orientation(value: Any, place: str) -> float:
    if value is None:  # Revolve itself writes `orientation: null`
        return 0.0
    angle = read_number(value)
    known = (0, 90, 180, 270, -90, -180, -270)
    if isinstance(angle, bool) or not isinstance(angle, int | float) or angle not in known:
        raise InputError(f"{place}: expected 0, 90, 180, 270 or -90 [deg]; found {show(value)}")
    return float(angle)


def _read_params(
    params: Any, place: str
) -> tuple[tuple[float, float, float] | None, dict[str, Any]]:
    """The colour, and everything else with the overrides checked."""
    if params is None:
        return None, {}
    if not isinstance(params, dict):
        raise InputError(f"{place}: expected a mapping; found {show(params)}")
    rest = {key: value for key, value in params.items() if key not in _COLORS}
    rest = check_overrides(rest, place)
    given = [key for key in _COLORS if key in params]
    if not given:
        return None, rest
    if len(given) < 3:
        raise InputError(
            f"{place}: expected red, green and blue, or none; found {', '.join(given)} only"
        )
    levels = [read_number(params[key]) for key in _COLORS]
    for key, level in zip(_COLORS, levels, strict=True):
        number = isinstance(level, int | float) and not isinstance(level, bool)
        if not number or not 0.0 <= level <= 1.0:
            raise InputError(f"{place}.{key}: expected a number from 0 to 1; found {show(level)}")
    return (float(levels[0]), float(levels[1]), float(levels[2])), rest


def _with_unique_names(modules: list[Module]) -> tuple[Module, ...]:
    """Names the nameless and tells apart those that share a name."""
    names = [m.name or f"{m.type}{i}" for i, m in enumerate(modules)]
    taken, seen = {*names}, {*_RESERVED}
    for i, name in enumerate(names):
        count = 2
        while name in seen:
            name = f"{names[i]}_{count}"
            count += 1
            if name in taken:  # another module's own name
                name = names[i]
        taken.add(name)
        seen.add(name)
        names[i] = name
    return tuple(replace(m, name=name) for m, name in zip(modules, names, strict=True))


# ------------------------------------------------------------------------- trimming


def trim_neutral(morphology: Morphology, density: float) -> Morphology:
    """Gives the core the electronics volume with which the robot neither sinks nor floats.

    Args:
        morphology: a robot that, without electronics in its core, is heavier than the water that
            it displaces. What electronics volume the core has is replaced.
        density: of the water [kg/m³].

    Returns:
        The same robot with `density * volume == mass` (to rounding); saving keeps it.

    Raises:
        InputError: the robot floats, so that no added volume can trim it.
    """
    density = check_number(density, "density", "kg/m3", above=True)
    core = morphology.modules[0]
    inside = sum(part.electronics_volume for part in core.kind.parts)
    total = morphology.mass / density - (morphology.volume - inside)
    if total < -1e-9 * morphology.volume:  # neutral to rounding is no floating
        raise InputError(
            f"{morphology.path or morphology.name}: expected a robot that sinks in water of "
            f"{density:g} kg/m3 and can be trimmed by adding volume; found one that floats: its "
            f"modules displace {-total:.4g} m3 too much (params: ballast of "
            f"{-total * density:.4g} kg would do)"
        )
    added = {"electronics_volume": max(total, 0.0)}
    core = replace(core, kind=apply_overrides(core.kind, added), params={**core.params, **added})
    return replace(morphology, modules=(core, *morphology.modules[1:]))


# ------------------------------------------------------------------------- writing


class _Dumper(yaml.SafeDumper):
    """Puts text in quotes that our own reader would take for a number (`1e-3`)."""

    yaml_implicit_resolvers = SafeLoader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        """Writes shared values out."""
        return True


def save_morphology(morphology: Morphology, path: str | Path) -> None:
    """Writes a robot's body as YAML that `load_morphology` reads back to an equal morphology.

    Types are written by name: a robot with a user's own types needs those again to be read.

    Args:
        morphology: the robot.
        path: the file.

    Raises:
        InputError: the file cannot be written, or `params` or `brain` hold what YAML cannot.
    """
    items: list[dict[str, Any]] = []
    for module in morphology.modules:
        item: dict[str, Any] = {"id": module.name, "type": module.type}
        turn = module.orientation
        item["orientation"] = int(turn) if turn.is_integer() else turn
        colors = zip(_COLORS, module.rgb, strict=True) if module.rgb is not None else ()
        params = {**dict(colors), **module.params}
        if params:
            item["params"] = params
        items.append(item)
        if module.parent >= 0:
            items[module.parent].setdefault("children", {})[module.slot] = item
    data: dict[str, Any] = {"id": morphology.name, "body": items[0]}
    if morphology.brain is not None:
        data["brain"] = morphology.brain
    try:
        text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
        Path(path).write_text(text, encoding="utf-8")
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        found = str(error).splitlines()[0]
        raise InputError(f"{path}: expected values that YAML can hold; found: {found}") from None
    except OSError as error:
        raise InputError(f"{path}: expected a file to write; found: {error.strerror}") from None
