"""`Ticket`: what an entrant needs to act in the hidden instances of a sealed-online season."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from sme_registry.errors import OptionError
from sme_registry.io import integer_in, read_json, to_json
from sme_registry.io.files import atomic_file, unwritable
from sme_registry.sealed.signing import Signer
from sme_registry.spec import Digest, Integer, Name, Setting, StrictModel, TupleOf, matching

_Count = Annotated[Integer, Field(ge=0)]


class TicketClass(StrictModel):
    """A class of the season, as far as an entrant knows it.

    Attributes:
      setting: all of a spec but its seed.
      instances: number of hidden tasks.
      budget: steps on each instance, over all lanes.
      name: of the class.
    """

    name: Name
    setting: Setting
    instances: Annotated[Integer, Field(ge=1)]
    budget: Annotated[Integer, Field(ge=1)]


def instance_name(class_name: str, instance: int) -> str:
    """What files and commands call a hidden instance: its class and its number in it, from 0.

    Examples:
      >>> from sme_registry.sealed import instance_name
      >>> instance_name("deep", 0)
      'deep-0'
    """
    return f"{class_name}-{instance}"


class Place(NamedTuple):
    """An instance of a ticket: its class, and its number in it, from 0."""

    member: TicketClass
    instance: int

    @property
    def name(self) -> str:
        return instance_name(self.member.name, self.instance)


class Ticket(StrictModel):
    """The answer to a request for a ticket, and the file that an entrant keeps of it.

    Attributes:
      season: the season's id.
      ticket: its number in the season.
      token: the password for its instances; whoever has it can take the steps.
      deadline: until when answers count, in UTC.
      lanes: the most copies of an instance that are stepped together.
      classes: instance i of the ticket counts over all of them, class by class.
      signer: signs the answers; null in a server's answer, which does not know the key.

    Examples:
      >>> from sme_registry.sealed import Ticket
      >>> [place.name for place in Ticket.read("ticket.json").places]
      ['deep-0', 'deep-1']
    """

    season: Name
    ticket: _Count
    token: Annotated[str, matching(r"^[0-9a-f]{64}$", "64 hex digits", repr=False)]
    deadline: Annotated[str, Field(max_length=40)]
    lanes: Annotated[Integer, Field(ge=1)]
    classes: Annotated[TupleOf[TicketClass], Field(min_length=1)]
    signer: Signer | None = None

    @property
    def places(self) -> Iterator[Place]:
        for member in self.classes:
            for instance in range(member.instances):
                yield Place(member, instance)

    def place(self, instance: int) -> Place:
        """Instance i of the ticket."""
        places = list(self.places)
        return places[integer_in("instance", instance, 0, len(places) - 1)]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Ticket:
        return cls.from_dict(read_json(path), os.fspath(path))

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the ticket into a new file that only its owner can read."""
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path, new=True) as stream:
                with contextlib.suppress(OSError, AttributeError):  # no modes on this system
                    os.fchmod(stream.fileno(), 0o600)
                stream.write(to_json(self.to_dict()).encode())
        except FileExistsError:
            raise OptionError(
                f"{path} already exists and is not replaced: its token is in no other file. Give "
                "another path."
            ) from None
        except OSError as error:
            raise unwritable(path, error) from None
        return path


class InstanceStatus(StrictModel):
    """How far a ticket is on one of its instances.

    Attributes:
      phase: no step taken; steps are taken; no more are, and answers are expected; answered.
      lanes: copies that are stepped together; null before `start`.
      requests: number of the last steps that were taken.
      used: steps of the budget that were taken, over all lanes.
    """

    phase: Literal["waiting", "stepping", "answering", "answered"]
    lanes: Annotated[Integer, Field(ge=1)] | None
    requests: _Count
    used: _Count


class JournalDigest(StrictModel):
    """The answer to a request for the digest of an instance's steps, once no more can follow.

    Attributes:
      journal: SHA-256 of the bodies of all requests for steps, in order.
    """

    journal: Digest


class TicketStatus(StrictModel):
    """The answer to a request for a ticket's status.

    Attributes:
      ticket: its number in the season.
      phase: "ended" once every instance is answered, or the deadline has passed.
      deadline: until when answers count, in UTC.
      instances: in the ticket's order.
    """

    ticket: _Count
    phase: Literal["running", "ended"]
    deadline: Annotated[str, Field(max_length=40)]
    instances: TupleOf[InstanceStatus]
