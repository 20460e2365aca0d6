"""Decoder: codes to decoded attributes, spherical harmonics by codebook (Sec. 4.3, Sec. 5)."""

from __future__ import annotations

from arch.client_work import ClientWork
from arch.component import Stream, UnitReport, ceil_div
from arch.config import AcceleratorConfig
from arch.memory.splat_record import (
    CHANNELS,
    PLAIN_ATTRIBUTES,
    codeword_bytes,
    plain_bytes,
    record_bytes,
)
from gaussians.work import FrameWork

WORD_BYTES = 16


def decoder(config: AcceleratorConfig, work: FrameWork, client: ClientWork) -> UnitReport:
    """Cycles = coded splats * (ceil(decoded bytes / width) + (stages - 1) * ceil(word / width)) +
    escaped ones * ceil(plain bytes / width): the first word is part of the record, the words of
    further stages are added to it.

    With decoded records in DRAM the payloads that arrived in this frame pass once; with
    ``compressed_in_dram`` every splat handed to projection passes in every frame. Codewords beyond
    the codebook buffer are fetched from DRAM; codewords are taken to be equally frequent. Without
    a decoder the host decodes: its time and energy are not modelled, its DRAM traffic is.
    """
    degree, record = work.sh_degree, record_bytes(config.splat_record, work.sh_degree)
    streams = [_incoming(client), _records(client, record)]
    if config.decoder is None:
        return UnitReport("decoder", 0, 0, 0, streams=tuple(streams))
    timing = config.decoder.timing
    coded, output_bytes = client.decoded_splats - client.escaped_splats, record
    if config.splat_record.layout == "compressed_in_dram":
        passes = 1 if work.shared_front_end else 2
        coded, output_bytes = work.front_end.submitted * passes, plain_bytes(degree)
    word, stages = codeword_bytes(degree), timing.codebook_stages
    cycles = coded * ceil_div(output_bytes, timing.bytes_per_cycle)
    cycles += coded * (stages - 1) * ceil_div(word, timing.bytes_per_cycle)
    cycles += client.escaped_splats * ceil_div(plain_bytes(degree), timing.bytes_per_cycle)
    if word:
        codebook = timing.codebook_words * stages * word
        missing = max(0, codebook - timing.codebook_buffer_kib * 1024)
        missed = ceil_div(coded * stages * missing, codebook)
        sentence = "codewords that are not in the codebook buffer"
        streams.append(Stream("codebook", sentence, read_bytes=missed * word, granule_bytes=word))
    return UnitReport(
        "decoder",
        1,
        cycles,
        cycles,
        config.decoder.fill.latency_cycles,
        {
            "attributes_dequantised": coded * (PLAIN_ATTRIBUTES + CHANNELS),
            "codebook_words_read": coded * stages * ceil_div(word, WORD_BYTES),
        },
        tuple(streams),
    )


def _incoming(client: ClientWork) -> Stream:
    sentence = "messages written by the radio and read for decoding"
    return Stream("incoming_stream", sentence, client.received_bytes, client.received_bytes)


def _records(client: ClientWork, record: int) -> Stream:
    sentence = "new splat records written into the subgraph"
    return Stream("new_records", sentence, write_bytes=client.decoded_splats * record)
