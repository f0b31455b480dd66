"""The two ways in which a wire protocol can be broken, by whose fault it is."""


class ProtocolError(Exception):
    """A rule of the wire protocol was broken."""


class LocalProtocolError(ProtocolError):
    """Our side asked for a message the protocol cannot express: a bug of the caller."""


class RemoteProtocolError(ProtocolError):
    """The peer sent bytes the protocol does not allow: resynchronise and retry."""
