"""Every error that dexkit raises on purpose, in one tree.

::

    DexkitError
    ├── HandError                       a hand could not do its exchange
    │   ├── HandLost (ConnectionError)      device unplugged, port closed by the other side
    │   ├── HandTimeout (TimeoutError)      the device did not answer in time
    │   ├── HandFault                       the device reports a hardware error
    │   ├── HandNotFound                    nothing answers at that path, id or serial number
    │   ├── HandRefused                     it answers but must not be driven (wrong model,
    │   │                                   Protocol 1.0 firmware, a register that will not take)
    │   └── CommandRejected (ValueError)    NaN, infinity or a wrong shape in a command
    ├── WireError (ValueError)          bytes that are not the message or packet they claim to be
    │   ├── TruncatedError                  the data end too early
    │   ├── OversizeError                   longer than the format or the stated bound allows
    │   ├── ChecksumError                   a CRC does not match
    │   └── EncodeError                     a value that the format cannot hold
    ├── DdsError
    │   ├── DdsUnavailable (ImportError)    CycloneDDS is not installed for this interpreter
    │   ├── DdsInstallError                 'dexkit setup-dds' cannot install it
    │   │   ├── InterpreterRefused              not for, or not into, this Python
    │   │   ├── DdsLibraryMissing               no library, compiler or source to build from
    │   │   └── DdsBuildFailed                  a step failed, or what was built does not work
    │   ├── DdsSetupError                   no such interface, no free participant index, ...
    │   └── TopicConflict                   another type or a foreign publisher on the topic
    ├── TraceError
    │   ├── TraceUnreadable                 not an mcap file, or nothing in it can be read
    │   └── TraceUnsupported                readable, but of a schema or encoding dexkit lacks
    ├── SessionError                    a session of another format cannot be read or written
    │   └── ExtraMissing (ImportError)      it needs a library of one of dexkit's extras
    ├── BackendError
    │   ├── UnknownBackend (LookupError)    no backend has that name
    │   ├── BackendConflict                 two installed packages claim one name
    │   └── BackendBroken                   the plug-in cannot be imported or is not a backend
    ├── ModelBroken                     a hand model of another package cannot be used
    ├── EmulatorError                   an emulated device cannot be set up as asked
    ├── ConformanceError                the kit itself cannot judge (not a verdict on the hand)
    ├── OutputError (OSError)           a file or stream cannot be written: disk full, pipe closed
    ├── ResourceError                   memory or threads do not suffice
    └── UsageError (ValueError)         arguments or configuration that make no sense

Errors that are also a built-in (in brackets) are caught by an ordinary ``except`` of that
built-in. Each carries a ``hint``: what to do next, printed by the command line.
"""

from __future__ import annotations

from collections.abc import Iterable

__all__ = [
    "BackendBroken",
    "BackendConflict",
    "BackendError",
    "ChecksumError",
    "CommandRejected",
    "ConformanceError",
    "DdsBuildFailed",
    "DdsError",
    "DdsInstallError",
    "DdsLibraryMissing",
    "DdsSetupError",
    "DdsUnavailable",
    "DexkitError",
    "EmulatorError",
    "EncodeError",
    "ExtraMissing",
    "HandError",
    "HandFault",
    "HandLost",
    "HandNotFound",
    "HandRefused",
    "HandTimeout",
    "InterpreterRefused",
    "ModelBroken",
    "OutputError",
    "OversizeError",
    "ResourceError",
    "SessionError",
    "TopicConflict",
    "TraceError",
    "TraceUnreadable",
    "TraceUnsupported",
    "TruncatedError",
    "UnknownBackend",
    "UsageError",
    "WireError",
]


class DexkitError(Exception):
    """Base of all errors raised on purpose.

    :param message: what is wrong, in one sentence.
    :param hint: what to do next, or empty.
    """

    exit_code = 1

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return self.message


class HandError(DexkitError):
    """A hand could not do its exchange."""


class HandLost(HandError, ConnectionError):
    """The device or its port has gone away; reopening may bring it back."""


class HandTimeout(HandError, TimeoutError):
    """The device did not answer in time."""


class HandFault(HandError):
    """The device reports a hardware error.

    :param bits: :class:`dexkit.hand.MotorError` bits per joint.
    """

    def __init__(self, message: str, *, bits: Iterable[int] = (), hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.bits = tuple(int(b) for b in bits)


class HandNotFound(HandError):
    """Nothing answers at the place that was given for the hand."""


class HandRefused(HandError):
    """A device answers but must not be driven."""


class CommandRejected(HandError, ValueError):
    """A command holds NaN or infinity, or has the wrong shape."""


class WireError(DexkitError, ValueError):
    """Bytes that are not a valid message, frame or packet."""


class TruncatedError(WireError):
    """The data end before the message is complete."""


class OversizeError(WireError):
    """Longer than the format or the stated bound allows."""


class ChecksumError(WireError):
    """A CRC does not match."""


class EncodeError(WireError):
    """A value that the format cannot hold."""


class DdsError(DexkitError):
    """Something about DDS went wrong."""


class DdsUnavailable(DdsError, ImportError):
    """CycloneDDS 0.10.x is not installed for this interpreter."""

    exit_code = 2


class DdsInstallError(DdsError):
    """CycloneDDS 0.10.x cannot be installed for this interpreter."""

    exit_code = 2


class InterpreterRefused(DdsInstallError):
    """It cannot or must not be installed into this Python's environment."""


class DdsLibraryMissing(DdsInstallError):
    """Something that the build needs is not on this machine."""


class DdsBuildFailed(DdsInstallError):
    """A step of the installation failed, or the built package does not work."""

    exit_code = 1


class DdsSetupError(DdsError):
    """The domain, interface or an entity cannot be set up."""

    exit_code = 2


class TopicConflict(DdsError):
    """Another type, or a publisher that must not be there, on the topic."""


class TraceError(DexkitError):
    """A recording cannot be used."""

    exit_code = 2


class TraceUnreadable(TraceError):
    """Not an mcap file, or nothing in it can be read."""


class TraceUnsupported(TraceError):
    """A schema or message encoding that dexkit does not know."""


class SessionError(DexkitError):
    """A session in another format than dexkit's recordings cannot be read or written."""

    exit_code = 2


class ExtraMissing(SessionError, ImportError):
    """A format needs a library that one of dexkit's extras installs."""

    __str__ = DexkitError.__str__


class BackendError(DexkitError):
    """A backend cannot be used."""

    exit_code = 2


class UnknownBackend(BackendError, LookupError):
    """No backend has that name."""

    __str__ = DexkitError.__str__


class BackendConflict(BackendError):
    """Two installed packages claim one name."""


class BackendBroken(BackendError):
    """The plug-in cannot be imported, or the object that it names is not a backend."""


class ModelBroken(DexkitError):
    """A hand model, or code that its profile refers to, cannot be imported or is not one."""

    exit_code = 2


class EmulatorError(DexkitError):
    """An emulated device cannot be set up as asked."""

    exit_code = 2


class ConformanceError(DexkitError):
    """The kit itself cannot judge; this is no result about the hand."""

    exit_code = 2


class OutputError(DexkitError, OSError):
    """A file or a stream cannot be written."""

    exit_code = 2


class ResourceError(DexkitError):
    """Memory or threads do not suffice, or a limit of them is reached."""

    exit_code = 2


class UsageError(DexkitError, ValueError):
    """Arguments or configuration that make no sense."""

    exit_code = 2
