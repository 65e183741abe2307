"""What proposes actions: networks that act, and planners that draw plans."""
