"""The studies of the package, a file each: cells, seeds, and the report that is made of rows."""
