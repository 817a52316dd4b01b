"""Files that state how sensors are mounted and how cameras project, for drives that do not: read, matched, written."""
