"""Tables and bags, read as plain columns and arrays; `EpisodeStore` makes a store of them."""
