"""What every check ends with."""


def exit_code(wrong):
    """Prints every disagreement, and returns 1 if there is any, else 0."""
    for line in wrong:
        print("WRONG", line)
    return 1 if wrong else 0
