"""Sans-I/O codecs and state machines of the wire protocol, both roles."""
