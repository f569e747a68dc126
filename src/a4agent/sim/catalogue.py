"""What the simulator can show: the declarations in `catalogue.toml`, read and checked.

[[thing]]
name = "drawer"                      # the object; splits are by thing
split = "dev"
from = "metaworld"                   # one of the packages
file = "sawyer_xyz/sawyer_drawer.xml"
root = "drawer"                      # a body, or the outermost body that holds a geom or mesh of this name
joints = { goal_slidey = [-0.12, 0.0] }
part.handle = { phrase = "the handle of the drawer", geoms = [{ mesh = "drawerhandle" }] }

[[thing.task]]
say = "Open the drawer."
part = "handle"
affordance = "pull"
"""

from __future__ import annotations

import functools
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from a4agent.errors import DataError, UnknownNameError
from a4agent.files import toml

Split = Literal["dev", "test"]
Use = Literal["table", "wall", "floor"]
USES: tuple[Use, ...] = ("table", "wall", "floor")


def _low_to_high(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] <= limits[1]:
        raise ValueError(f"a range goes from low to high, not from {limits[0]:g} to {limits[1]:g}")
    return limits


Range = Annotated[tuple[float, float], AfterValidator(_low_to_high)]


class Declared(BaseModel):
    """Immutable, and a misspelt key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Package(Declared):
    """An asset package of the index, installed without its dependencies and read as data."""

    version: str
    licence: str
    folder: str


class Selector(Declared):
    """Geoms that match every field given.

    `type` is box, capsule, cylinder, mesh, ...; `rgba` compares to two decimals; `size` and `pos` (in the
    geom's body) are metres and compare to the millimetre.
    """

    body: str | None = None
    geom: str | None = None
    mesh: str | None = None
    material: str | None = None
    type: str | None = None
    rgba: tuple[float, float, float, float] | None = None
    size: tuple[float, float, float] | None = None
    pos: tuple[float, float, float] | None = None

    @model_validator(mode="after")
    def _says_something(self) -> Selector:
        if not self.model_fields_set:
            raise ValueError("a selector needs a body, geom, mesh, material, type, rgba, size or pos")
        return self


class Part(Declared):
    """One region of a thing: the geoms that any of the selectors matches."""

    phrase: str
    geoms: Annotated[tuple[Selector, ...], Field(min_length=1)]


class Task(Declared):
    """What a person says and where that points. Several parts: any of them will do, or all are meant."""

    say: str
    part: str | tuple[str, ...]
    affordance: str
    direct: bool = True
    choose: Literal["any", "all"] = "any"
    phrase: str | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        return (self.part,) if isinstance(self.part, str) else self.part


class Model(Declared):
    """A body of a model file. `euler` (degrees, x then y then z) turns it as it is put down."""

    package: str = Field(alias="from")
    file: str
    root: str | None = None
    euler: tuple[float, float, float] = (0.0, 0.0, 0.0)
    joints: dict[str, Range] = {}


class Thing(Model):
    """Something to handle. It stands on a table of ours, or `in_place`: where it is in its own file.

    Things of one `kind` (by default the name) are never in one picture; `beside = false` keeps a large
    thing from standing around in pictures of others. `without` names bodies of its
    file to leave out. The camera looks at the thing from `front` (degrees in the ground plane, from x
    towards y; -90 is from -y) plus or minus `spread`, from `elevation` degrees above, and sees at least
    `surroundings` metres around the thing's middle when it is not close to a part.
    """

    name: str
    split: Split
    kind: str = ""
    beside: bool = True
    in_place: bool = False
    without: tuple[str, ...] = ()
    front: float = -90.0
    spread: float = 55.0
    elevation: Range = (15.0, 55.0)
    surroundings: float = 0.0
    parts: Annotated[dict[str, Part], Field(alias="part", min_length=1)]
    tasks: Annotated[tuple[Task, ...], Field(alias="task", min_length=2, max_length=4)]

    @model_validator(mode="before")
    @classmethod
    def _kind_is_the_name(cls, data: Any) -> Any:
        return {"kind": data.get("name"), **data} if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _tasks_name_parts(self) -> Thing:
        unknown = {part for task in self.tasks for part in task.parts} - set(self.parts)
        if unknown:
            raise ValueError(f"{self.name!r} has a task for parts it does not declare: {sorted(unknown)}")
        if any(len(task.parts) > 1 and task.phrase is None for task in self.tasks):
            raise ValueError(f"{self.name!r} has a task for several parts without a phrase of its own")
        return self

    def phrase(self, task: Task) -> str:
        """The part phrase that answers `task` ("the handle of the drawer")."""
        return task.phrase or self.parts[task.parts[0]].phrase


class Prop(Model):
    """Something that only stands around."""

    name: str


class Arm(Model):
    """A robot arm: `hand` is the body to bring near the thing, `joints` the ranges of its pose."""

    name: str
    hand: str


class Surface(Declared):
    """Pictures for tables, walls or floors."""

    package: str = Field(alias="from")
    files: Annotated[tuple[str, ...], Field(min_length=1)]
    use: tuple[Use, ...]


class Catalogue(Declared):
    """All declarations of one file."""

    packages: Annotated[dict[str, Package], Field(alias="package")]
    things: Annotated[tuple[Thing, ...], Field(alias="thing")]
    props: Annotated[tuple[Prop, ...], Field(alias="prop")] = ()
    arms: Annotated[tuple[Arm, ...], Field(alias="arm")] = ()
    surfaces: Annotated[tuple[Surface, ...], Field(alias="surface")] = ()

    @model_validator(mode="after")
    def _names_fit(self) -> Catalogue:
        names = [entry.name for entry in (*self.things, *self.props, *self.arms)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"declared twice: {twice}")
        entries = (*self.things, *self.props, *self.arms, *self.surfaces)
        unknown = sorted({entry.package for entry in entries} - set(self.packages))
        if unknown:
            raise ValueError(f"packages that are not declared: {unknown}")
        return self

    def pictures(self, use: Use) -> tuple[tuple[str, str], ...]:
        """(package, file) of every surface picture for this use."""
        return tuple((one.package, file) for one in self.surfaces if use in one.use for file in one.files)

    def split(self, split: Split | None) -> tuple[Thing, ...]:
        """The things of one split, or all of them."""
        return tuple(thing for thing in self.things if split is None or thing.split == split)

    def thing(self, name: str) -> Thing:
        """The thing called `name`. Raises UnknownNameError."""
        for thing in self.things:
            if thing.name == name:
                return thing
        raise UnknownNameError.of("thing", name, [thing.name for thing in self.things])


def read_catalogue(path: Path) -> Catalogue:
    """Read a file of declarations.

    Raises:
        DataError: it is not there, not TOML, or declares something that does not fit; says what and where.
    """
    try:
        declared = toml.loads(path.read_text(encoding="utf-8"))
        return Catalogue.model_validate(declared)
    except (OSError, ValueError) as error:
        details = "; ".join(_where(entry) for entry in error.errors()) if isinstance(error, ValidationError) else error
        raise DataError(f"{str(path)!r} does not declare simulator things: {details}") from error


@functools.cache
def built_in() -> Catalogue:
    """The catalogue that comes with this package."""
    with resources.as_file(resources.files("a4agent.sim") / "catalogue.toml") as path:
        return read_catalogue(path)


def _where(error: object) -> str:
    assert isinstance(error, dict)
    return f"{'.'.join(str(step) for step in error['loc'])}: {error['msg']}"
