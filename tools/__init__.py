"""Scripts that make things for the project: pages, pictures, records, definitions, and the list of wheels."""
