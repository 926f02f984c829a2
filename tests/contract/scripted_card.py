"""A card with a handful of commands, for tests of the link alone: its answers are known by heart.

It keeps P- and I-variables, refuses what it does not know, and can be made slow or talkative.
Framing of answers is written here again from the manual, not taken from the package.
"""

import re
import struct

_TOKEN = re.compile(
    r"(?P<name>[IPQM]\d+)(?P<assign>=(?P<value>-?[\d.]+))?|(?P<range>[IPQM]\d+\.\.\d+)|(?P<word>VER|CID|TYPE)"
)


class ScriptedCard:
    """State of the card; the ports below share it."""

    def __init__(self, **modes: int) -> None:
        self.variables: dict[str, str] = {"I3": "2", "I4": "0", "I6": "1", "I9": "2"}
        self.variables.update({name: str(value) for name, value in modes.items()})
        self.memory = bytearray(0x4000)
        self.executed: list[str] = []
        self.controls: list[int] = []

    def mode(self, name: str) -> int:
        return int(self.variables[name])

    def run(self, line: str) -> tuple[list[str], int | None]:
        """Data lines and error number of one command line."""
        self.executed.append(line)
        text = re.sub(r"\s+", "", line).upper()
        lines: list[str] = []
        position = 0
        while position < len(text):
            match = re.compile(r"([IPQM])(\d+)\.\.(\d+)").match(text, position)
            if match:
                first, last = int(match[2]), int(match[3])
                lines += [self.value(f"{match[1]}{k}") for k in range(first, last + 1)]
            else:
                match = _TOKEN.match(text, position)
                if match is None:
                    return lines, 3
                if match["assign"]:
                    self.variables[match["name"]] = match["value"]
                elif match["name"]:
                    lines.append(self.value(match["name"]))
                else:
                    lines.append(
                        {"VER": "1.947  ", "CID": "603382", "TYPE": "TURBO2, X4"}[match["word"]]
                    )
            position = match.end()
        return lines, None

    def value(self, name: str) -> str:
        text = self.variables.get(name, "0")
        return f"{name}={text}" if self.mode("I9") & 1 else text

    def answer(self, line: str) -> bytes:
        """Bytes that answer a line in the modes that hold when it has been carried out."""
        lines, error = self.run(line)
        i3, i4, i6 = self.mode("I3"), self.mode("I4"), self.mode("I6")
        out = b""
        for text in lines:
            part = (b"\n" if i3 in (1, 3) else b"") + text.encode() + b"\r"
            out += part + (bytes([sum(part) % 256]) if i4 in (1, 3) else b"")
        if error is not None:
            feed = b"\n" if i3 in (1, 3) else b""
            name = b"ERR%03d\r" % error
            return out + {0: b"\a", 1: b"\a" + feed + name, 2: b"\a", 3: b"\a\r" + feed + name}[i6]
        out += {0: b"", 1: b"\n", 2: b"\x06", 3: b"\x06"}[i3]
        return out + (bytes([sum(line.encode()) % 256]) if i4 in (1, 3) else b"")


class PacketPort:
    """The packet port of a scripted card: ``receive`` takes bytes and gives bytes."""

    def __init__(self, card: ScriptedCard, part: int = 1400) -> None:
        self.card = card
        self.part = part
        self._in = bytearray()
        self._out = bytearray()

    def __call__(self, data: bytes) -> bytes:
        self._in += data
        out = b""
        while len(self._in) >= 8:
            _, code, value, _, length = struct.unpack_from(">BBHHH", self._in)
            carries = code in (0xB0, 0xBF, 0xC6, 0xB5, 0xBA, 0xBB)
            end = 8 + (length if carries else 0)
            if len(self._in) < end:
                break
            payload = bytes(self._in[8:end])
            del self._in[:end]
            out += self.serve(code, value, length, payload)
        return out

    def serve(self, code: int, value: int, length: int, payload: bytes) -> bytes:  # noqa: PLR0911
        if code == 0xB3:
            self._out.clear()
            return b"\x40"
        if code == 0xBF:
            self._out = bytearray(self.card.answer(payload.decode()))
            return self.next_part()
        if code == 0xC5:
            return self.next_part() or b"\x00"
        if code == 0xB4:
            return bytes(self.card.memory[value : value + length])
        if code == 0xB5:
            self.card.memory[value : value + len(payload)] = payload
            return b"\x40"
        if code == 0xBB:
            (cell,) = struct.unpack_from("<I", self.card.memory, value)
            on, off = struct.unpack("<II", payload)
            struct.pack_into("<I", self.card.memory, value, (cell | on) & ~off & 0xFFFFFFFF)
            return b"\x40"
        if code == 0xB6:
            self.card.controls.append(value)
            return b"\x40"
        if code == 0xC4:
            return b"0.5 7.2\r" if value == 6 else b"\x00"
        if code == 0xC6:
            for number, line in enumerate(payload.rstrip(b"\0").split(b"\0"), start=1):
                _, error = self.card.run(line.decode())
                if error is not None:
                    return struct.pack("<HBB", number, error, 0x80)
            return bytes(4)
        raise AssertionError(f"request {code:02X}")

    def next_part(self) -> bytes:
        part, self._out = bytes(self._out[: self.part]), self._out[self.part :]
        return part


class LinePort:
    """An ASCII port of a scripted card."""

    def __init__(self, card: ScriptedCard) -> None:
        self.card = card
        self._line = bytearray()

    def __call__(self, data: bytes) -> bytes:
        out = b""
        for code in data:
            if code == 0x0D:
                line, self._line = self._line.decode("latin1"), bytearray()
                out += self.card.answer(line)
            elif code == 0x18:
                self._line.clear()
            elif code == 0x06:
                out += self.reported(b"0.5 7.2\r")
            elif code < 0x20:
                self.card.controls.append(code)
            else:
                self._line.append(code)
        return out

    def reported(self, line: bytes) -> bytes:
        """A line that answers a control character: no acknowledgement, but its sum."""
        return line + (bytes([sum(line) % 256]) if self.card.mode("I4") in (1, 3) else b"")
