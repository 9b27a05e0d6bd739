"""What the user says of contact, and the conditions that follow from the geometry."""
