"""The conformance kit: numbered checks of a service against DB34/T 4101-2022, clause by clause and row by row."""
