"""The wire: keys, structs and their encoding. Standard library and msgspec only."""
