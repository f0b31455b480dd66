"""The errors of the program, by what the caller does next."""


class NamodError(Exception):
    """Something a person can mend; its text says what, where, the value, the limit and the remedy."""


class ConfigError(NamodError):
    """The config or another input is wrong: exit code 2, nothing was written, nothing has moved."""


class CommunicationError(NamodError):
    """No usable answer in time: retried a bounded number of times, counted in the journal."""


class DeviceFaultError(NamodError):
    """The device reports a fault: this facet or camera is out, the rest goes on degraded or holds."""


class LimitError(NamodError):
    """Refused before anything moved; never clipped silently."""


class DataQualityError(NamodError):
    """The recording as a whole is unusable: record again."""


class StoreError(NamodError):
    """History cannot be written or trusted: stop before any motion."""


class SafetyStop(NamodError):  # noqa: N818 - the name every part of the program and its documents use
    """An invariant is broken: all drives stop, the state is `held`, a person releases."""
