"""Settings of the table as a whole: envelope, node, servers, recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.addresses import LOCAL, Address, IPNetwork
from router.table.keys import SOME, Named, Shape
from router.table.units import DISK_SIZE, DURATION


@dataclass(frozen=True, slots=True)
class EnvelopeSettings:
    """Which protobuf message wraps every payload on the wire.

    `protos` and `lock` are absolute paths; without `lock`, the lock file is beside the protos. One of several envelopes
    has a `name`.
    """

    protos: Located[Path]
    """The folder with the .proto files, relative to this file. Default: the protos shipped with the router.

    Title: Proto folder
    Example: ../protos
    """
    message: Located[str]
    """The name of the protobuf message that every datagram holds.

    Title: Envelope message
    Example: PBEnvelope
    """
    oneof: Located[str] | None = None
    """The name of the envelope's oneof whose members are the payload cases. Instead of it: `cases` or `case`.

    Title: Payload oneof
    Example: payload
    """
    cases: Annotated[tuple[Located[str], ...], SOME] = ()
    """Instead of `oneof`: fields of the envelope whose type is a message. Each one that is present in a datagram is a
    message of its own.

    Title: Fields that are cases
    Example: [detection, geometry]
    """
    case: Annotated[Located[str] | None, Shape("node_name")] = None
    """Instead of `oneof`. Alone: the datagram is itself the message of a single payload case, which gets this name.
    With `payload`: the field of the envelope that names the message.

    Title: Only case, or field with its name
    Example: referee
    Example: name
    """
    payload: Annotated[Located[str] | None, Shape("node_name")] = None
    """The field of the envelope with the bytes of the message that the field `case` names by its full name. Each
    message of `protos` is a payload case.

    Title: Field with the payload
    Example: data
    """
    lock: Located[Path] | None = None
    """The file that records the field numbers, relative to this file. Default: envelope.lock.json in the folder of the
    .proto files; for one of `envelopes`, NAME.lock.json there. Set it if that folder is not yours to change, such as a
    submodule.

    Title: Lock file
    Example: ../envelope.lock.json
    """
    exclude: tuple[Located[str], ...] = ()
    """Files and folders of `protos`, relative to it, that are ignored: files of other people in that folder that the
    envelope does not import.

    Title: Excluded protos
    Example: [motor/old.proto, tests]
    """
    because: Annotated[str | None, Shape("reason")] = None
    """Why boards accept envelopes whose fields beside the payload are empty. In envelopes that the router makes from
    ROS messages and for deadman timers, it fills only what 'set' of the endpoint has; forwarded ones keep theirs.

    Example: boards do not check the sequence number
    Error: must be a text that says why these fields may be empty
    """
    name: str = ""

    @property
    def lock_file(self) -> Located[Path] | None:
        """The lock file, None for the default of a table with one envelope."""
        if self.lock is not None or not self.name:
            return self.lock
        return Located(self.protos.value / f"{self.name}.lock.json", self.protos.span)

    @property
    def choice(self) -> Mapping[str, Sequence[Located[str]]]:
        """The keys that say how the envelope holds payloads: `oneof`, `cases`, `case`, or `case` and `payload`."""
        keys = {"oneof": self.oneof, "case": self.case, "payload": self.payload}
        chosen = {name: (value,) for name, value in keys.items() if value is not None}
        return {**chosen, "cases": self.cases} if self.cases else chosen

    @property
    def has_many(self) -> bool:
        """Whether each message of the protos is a payload case, not only those that the envelope contains."""
        return self.payload is not None


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """How the router appears in the ROS graph.

    `span` is the key `node`, `diagnostics` the span of its key, None if off.

    Title: ROS node
    """

    name: Annotated[str, Shape("node_name")] = "rover_router"
    """The ROS node's name.

    Title: Node name
    """
    namespace: Annotated[str, Shape("namespace")] = "/"
    """The ROS namespace in which relative topic names are resolved.

    Title: Node namespace
    """
    diagnostics: SourceSpan | None = None
    """Publish one status for each route and endpoint on /diagnostics once a second, for ROS's own monitors."""
    span: SourceSpan | None = None


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """A server of the router, for clients from `networks` or from anywhere. `span` is its key in the table."""

    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    """The local TCP address that clients connect to."""
    networks: Annotated[tuple[IPNetwork, ...], Named("from"), SOME] = ()
    """Only clients in these networks may connect, and always those on the router's own computer, which include all
    clients of a proxy there. Others are refused, counted and logged. Without this key anybody may connect.

    Title: Clients' networks
    Example: [192.168.0.0/24]
    """


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Record every received datagram, including rejected ones, in MCAP files.

    `span` is the key `record`; `directory` is an absolute path. `last` and `max_age` are in ns, sizes in bytes.

    Title: Recording
    """

    span: SourceSpan
    directory: Path
    """Where the files are written, relative to this file. The directory is created if it is missing.

    Example: ../recordings
    """
    continuous: bool = True
    """Write everything to files all the time. false: write only what 'last' holds, on request."""
    last: Annotated[int | None, DURATION] = None
    """Keep this much in memory, and save it to a file of its own on SIGUSR1, on POST /record/save, and when a deadman
    trips.

    Example: 60s
    """
    max_size: Annotated[int, DISK_SIZE, Named("rotate_after.size")] = 256 << 20
    """Begin a new file when the current one reaches this size.

    Example: 256MiB
    """
    max_age: Annotated[int, DURATION, Named("rotate_after.age")] = 600_000_000_000
    """Begin a new file when the current one reaches this age.

    Example: 10min
    """
    retention: Annotated[int, DISK_SIZE] = 4 << 30
    """Delete the router's oldest files in the directory when their total size exceeds this.

    Example: 4GiB
    """


HOW_TO_KEEP = (
    "add `last: 60s` to the table's 'record', or `record: {directory: ../recordings, last: 60s, continuous: false}`, "
    "and restart the router"
)
"""What to do if a router keeps no datagrams to save."""
