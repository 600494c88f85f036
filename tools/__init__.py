"""Scripts of the project: pages, pictures, records, definitions, and the list of wheels."""
