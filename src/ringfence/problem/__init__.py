"""What is to be solved: what agents see, what is dangerous, and in which units."""
