"""The page of all rules of `sceneloom validate`, out of the tables that it checks by."""


def rules_page() -> str:
    """The text of the page: a row a rule, those of single profiles apart."""
    from sceneloom.checks.validation import catalogue

    head = "| rule | | expectation | remedy |\n| --- | --- | --- | --- |"
    rows: dict[str, list[str]] = {}
    for rule in catalogue():
        marks = ", ".join([rule.severity, *(["fix"] if rule.fixable else [])])
        title = f"Only with `--profile {rule.only_in[0]}`" if rule.only_in else "In every profile"
        rows.setdefault(title, []).append(f"| `{rule.id}` | {marks} | {rule.summary} | {rule.remedy} |")
    tables = [f"## {title}\n\n" + "\n".join([head, *lines]) for title, lines in rows.items()]
    first = (
        "`sceneloom validate --rules` prints this list; `--fix` repairs rules marked *fix*. See [checks](../checks.md)."
    )
    return "\n\n".join(["# Rules of validate", first, *tables]) + "\n"
