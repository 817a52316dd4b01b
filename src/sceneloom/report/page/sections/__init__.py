"""The sections of a report's page, one module each: numbers in, blocks of texts, tables and plots out."""
