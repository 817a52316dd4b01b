"""The configuration data of DB34/T 4101-2022: predefined and added properties, their types, and what they mean."""
