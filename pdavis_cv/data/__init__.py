"""Sample data that ships with the library; see THIRD_PARTY.md."""
