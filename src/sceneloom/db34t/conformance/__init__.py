"""The conformance kit: checks of any server of the standard, clause by clause."""
