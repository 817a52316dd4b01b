"""The records of DB34/T 4101-2022, tables 1 and 3 to 10, and the forms in which they travel."""
