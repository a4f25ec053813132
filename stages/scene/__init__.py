"""What stands where: the objects, how they stand to each other, and how that compares with the truth."""
