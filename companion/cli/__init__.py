"""The command `mavfdi`."""


def main() -> int:
    return 0
