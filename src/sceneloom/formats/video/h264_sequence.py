"""The one thing of an H.264 sequence parameter set that no library tells: where the samples of colour lie."""

_LONG_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
_FOUR_FOUR_FOUR, _OWN_ASPECT = 3, 255


class _Bits:
    """Reads a set bit by bit."""

    def __init__(self, content: bytes) -> None:
        self._bits = "".join(f"{byte:08b}" for byte in content)
        self._at = 0

    def number(self, length: int) -> int:
        """A number of so many bits."""
        self._at += length
        return int(self._bits[self._at - length : self._at] or "0", 2)

    def flag(self) -> bool:
        """One bit."""
        return self.number(1) == 1

    def count(self) -> int:
        """A number of Exp-Golomb code. Source: H.264, 9.1."""
        zeros = 0
        while self._at + zeros < len(self._bits) and self._bits[self._at + zeros] == "0":
            zeros += 1
        self._at += zeros
        return self.number(zeros + 1) - 1

    def skip_counts(self, how_many: int) -> None:
        """Pass over so many numbers of Exp-Golomb code."""
        for _ in range(how_many):
            self.count()


def colour_place(sequence_set: bytes) -> int:
    """Tell where the samples of colour lie: 0 at the left edge of their two by two pixels, 1 in the middle, ….

    Args:
        sequence_set: the parameter set with its header byte.

    Source: H.264, 7.3.2.1.1, E.1.1; table E-1 and figure E-1 for the numbers.
    """
    bits = _Bits(sequence_set[4:].replace(b"\x00\x00\x03", b"\x00\x00"))
    bits.count()
    if sequence_set[1] in _LONG_PROFILES:
        _skip_format(bits)
    bits.count()
    _skip_order(bits)
    bits.count()
    bits.flag()
    bits.skip_counts(2)
    if not bits.flag():
        bits.flag()
    bits.flag()
    if bits.flag():
        bits.skip_counts(4)
    return _place_in_usability(bits) if bits.flag() else 0


def _skip_format(bits: _Bits) -> None:
    kind = bits.count()
    if kind == _FOUR_FOUR_FOUR:
        bits.flag()
    bits.skip_counts(2)
    bits.flag()
    if bits.flag():
        for number in range(12 if kind == _FOUR_FOUR_FOUR else 8):
            if bits.flag():
                _skip_scaling(bits, 16 if number < 6 else 64)


def _skip_scaling(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            code = bits.count()
            step = (code + 1) // 2 if code % 2 else -(code // 2)
            following = (last + step) % 256
        last = following or last


def _skip_order(bits: _Bits) -> None:
    kind = bits.count()
    if kind == 0:
        bits.count()
    elif kind == 1:
        bits.flag()
        bits.skip_counts(2)
        bits.skip_counts(bits.count())


def _place_in_usability(bits: _Bits) -> int:
    if bits.flag() and bits.number(8) == _OWN_ASPECT:
        bits.number(32)
    if bits.flag():
        bits.flag()
    if bits.flag():
        bits.number(4)
        if bits.flag():
            bits.number(24)
    return bits.count() if bits.flag() else 0
