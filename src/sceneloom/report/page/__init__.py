"""The page of a report: what stands where, and the template that it is put into."""
