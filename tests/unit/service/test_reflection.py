"""A caller that has nothing but the address: it asks the server what there is, and calls it."""

import grpc
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase


def test_the_service_reports_its_methods_and_messages(serve):
    with grpc.insecure_channel(serve().address) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        assert set(database.get_services()) == {
            "sceneloom.db34t4101.v1.DataFusion",
            "grpc.health.v1.Health",
            "grpc.reflection.v1alpha.ServerReflection",
        }
        service = DescriptorPool(database).FindServiceByName("sceneloom.db34t4101.v1.DataFusion")
        method = service.FindMethodByName("GetProperty")
        request, reply = GetMessageClass(method.input_type), GetMessageClass(method.output_type)
        call = channel.unary_unary(
            f"/{service.full_name}/{method.name}",
            request_serializer=request.SerializeToString,
            response_deserializer=reply.FromString,
        )
        assert call(request(name="lidar_frequency"), timeout=30).value.integer_value == 10


def test_the_service_says_that_it_is_well(serve):
    with grpc.insecure_channel(serve().address) as channel:
        health = health_pb2_grpc.HealthStub(channel)
        for name in ("", "sceneloom.db34t4101.v1.DataFusion"):
            answer = health.Check(health_pb2.HealthCheckRequest(service=name), timeout=30)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING
