"""Readers of the whole messages of bags whose end is missing, as after a full disk or a crash of the recorder.

The readers of the package rosbags need the index at the end of a bag. Those below derive from them and read the records
of a file from its beginning, up to the first one that is cut off.
"""

import os
from collections import defaultdict
from collections.abc import Collection, Generator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import apsw
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import ReaderError as Rosbag1Error
from rosbags.rosbag1.reader import Header, IndexData, RecordType, read_bytes, read_uint32
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader, deserialize_uint64, read_exact, read_string, skip_sized
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader


def cut_off_reader(path: Path) -> Rosbag1Reader | Rosbag2Reader:
    """Return a reader, not yet opened, of the whole messages of a .bag, .mcap or .db3 file."""
    if path.suffix == ".bag":
        return CutOffRosbag1Reader(path)
    reader = Rosbag2Reader(path)
    reader.storage = CutOffMcapReader(path) if path.suffix == ".mcap" else CutOffSqlite3Reader(path)
    return reader


class CutOffRosbag1Reader(Rosbag1Reader):
    """Reader of the whole chunks of a ROS 1 bag. It indexes the messages itself."""

    def open(self) -> None:
        """Index the messages; without a whole chunk there are none."""
        self.bio = self.path.open("rb")
        self.bio.readline()
        indexes: dict[int, list[IndexData]] = defaultdict(list)
        with suppress(Rosbag1Error):  # at the end of the file, or at the first record that is cut off
            while True:
                position = self.bio.tell()
                if Header.read(self.bio).get_uint8("op") == RecordType.CHUNK:
                    self.bio.seek(position)
                    chunk = self.read_chunk()
                    self.bio.seek(chunk.datapos)
                    content = chunk.decompressor(read_bytes(self.bio, chunk.datasize))
                    self.chunks[position] = chunk
                    self._index(position, content, indexes)
                else:
                    self.bio.seek(read_uint32(self.bio), os.SEEK_CUR)
        self.indexes = {connection.id: sorted(indexes[connection.id]) for connection in self.connections}

    def _index(self, position: int, content: bytes, indexes: dict[int, list[IndexData]]) -> None:
        known = {connection.id for connection in self.connections}
        records = BytesIO(content)
        while (offset := records.tell()) < len(content):
            header = Header.read(records)
            number = header.get_uint32("conn")
            if header.get_uint8("op") == RecordType.MSGDATA:
                indexes[number].append(IndexData(header.get_time("time"), position, offset))
            elif number not in known:
                records.seek(offset)
                file, self.bio = self.bio, records  # read_connection reads from self.bio
                self.connections.append(self.read_connection())
                self.bio = file
                continue
            records.seek(read_uint32(records), os.SEEK_CUR)


class CutOffMcapReader(McapReader):
    """Reader of the whole records of an MCAP file."""

    def _open(self) -> None:
        assert self.bio is not None
        size = os.fstat(self.bio.fileno()).st_size
        self.bio.seek(9)
        skip_sized(self.bio)
        self.data_start = self.data_end = self.bio.tell()
        while (kind := self.bio.read(1)) and len(length := self.bio.read(8)) == 8:
            end = self.bio.tell() + deserialize_uint64(length)[0]
            if end > size:
                break
            if kind == b"\x06":
                self.chunks.append(self._chunk(self.data_end, end))
            self.data_end = self.bio.seek(end)
        self.meta_scan()
        for chunk in self.chunks:
            chunk.channel_count.update(dict.fromkeys(self.channels, 1))  # `messages` leaves out chunks without any

    def _chunk(self, start: int, end: int) -> ChunkInfo:
        assert self.bio is not None
        first, last, size = (deserialize_uint64(read_exact(self.bio, 8))[0] for _ in range(3))
        read_exact(self.bio, 4)
        compression = read_string(self.bio)
        compressed_size = deserialize_uint64(read_exact(self.bio, 8))[0]
        return ChunkInfo(first, last, start, end - start, {}, 0, compression, compressed_size, size, {})


class CutOffSqlite3Reader(Sqlite3Reader):
    """Reader of an SQLite file up to the first missing page, in the order in which messages were written."""

    def open(self) -> None:
        """Read the topics.

        Raises:
            apsw.Error: The file is no database, or its topics are cut off.
        """
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        self.dbconn = apsw.Connection(f"file:{self.path}?immutable=1", flags=flags)
        # Otherwise SQLite refuses a file with fewer pages than its header states.
        self.dbconn.execute("PRAGMA writable_schema=ON")
        definitions: dict[Any, Any] = {}
        with suppress(apsw.SQLError):  # older bags have no such table
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
            definitions = dict(self.dbconn.execute(query))
        formats = MessageDefinitionFormat
        for number, topic, kind in self.dbconn.execute("SELECT id, name, type FROM topics ORDER BY id"):
            text = definitions.get(kind)
            definition = MessageDefinition(formats.MSG if text else formats.NONE, text or "")
            extra = ConnectionExtRosbag2("cdr", [])
            self.connections.append(Connection(number, topic, kind, definition, "", 0, extra, self))

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield the messages of some connections, without the index of times, which may be cut off.

        Args:
            connections: Connections to read.
            start: Not used; there is no index of times.
            stop: Not used.

        Raises:
            apsw.Error: At the first missing page.
        """
        assert self.dbconn is not None
        by_id = {connection.id: connection for connection in connections}
        query = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"
        for number, time, data in self.dbconn.execute(query):
            if number in by_id:
                yield by_id[number], time, data
