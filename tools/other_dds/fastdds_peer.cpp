// A client on Fast DDS 2.x: reads the states of a left Dex1-1, sends commands until the gripper is
// where they say, and prints what it saw as JSON, like tools/platforms/peer.py.
//
//   fastdds_peer DOMAIN
//
// It stays on 127.0.0.1. Types are written out here, with Fast DDS's own CDR, so that it can be
// built without its code generator.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>
#include <functional>
#include <memory>
#include <thread>
#include <vector>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

constexpr float kTarget = 2.7f;  // rad, half of the stroke
constexpr float kClose = 0.05f;  // rad
constexpr auto kPatience = std::chrono::seconds(30);
constexpr auto kPeriod = std::chrono::milliseconds(5);

struct MotorState {
    uint8_t mode = 0;
    float q = 0, dq = 0, ddq = 0, tau_est = 0, q_raw = 0, dq_raw = 0, ddq_raw = 0;
    uint8_t temperature = 0;
    uint32_t lost = 0, reserve[2] = {0, 0};
};

struct MotorCmd {
    uint8_t mode = 0;
    float q = 0, dq = 0, tau = 0, kp = 0, kd = 0;
    uint32_t reserve[3] = {0, 0, 0};
};

void visit(Cdr& cdr, MotorState& m) {
    cdr >> m.mode >> m.q >> m.dq >> m.ddq >> m.tau_est >> m.q_raw >> m.dq_raw >> m.ddq_raw;
    cdr >> m.temperature >> m.lost >> m.reserve[0] >> m.reserve[1];
}

void write(Cdr& cdr, const MotorCmd& m) {
    cdr << m.mode << m.q << m.dq << m.tau << m.kp << m.kd;
    cdr << m.reserve[0] << m.reserve[1] << m.reserve[2];
}

void visit(Cdr&, MotorCmd&) {}
void write(Cdr&, const MotorState&) {}

// A message that is one sequence of motors.
template <typename Motor>
class Motors : public fast::TopicDataType {
public:
    explicit Motors(const char* name) {
        setName(name);
        m_typeSize = 2048;
        m_isGetKeyDefined = false;
    }

    bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
        FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        payload->encapsulation = cdr.endianness() == Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
        cdr.serialize_encapsulation();
        const auto& motors = *static_cast<std::vector<Motor>*>(data);
        cdr << static_cast<uint32_t>(motors.size());
        for (const auto& motor : motors) write(cdr, motor);
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }

    bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
        FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        cdr.read_encapsulation();
        auto& motors = *static_cast<std::vector<Motor>*>(data);
        uint32_t count = 0;
        cdr >> count;
        if (count > 32) return false;
        motors.resize(count);
        for (auto& motor : motors) visit(cdr, motor);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void*) override {
        return [this] { return m_typeSize; };
    }
    void* createData() override { return new std::vector<Motor>; }
    void deleteData(void* data) override { delete static_cast<std::vector<Motor>*>(data); }
    bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

int fail(const char* what) {
    std::fprintf(stderr, "error: %s\n", what);
    return 2;
}

int main(int count, char** words) {
    if (count != 2) return fail("give the domain");
    const int domain = std::atoi(words[1]);
    fast::DomainParticipantQos qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.emplace_back("127.0.0.1");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    // loopback has no multicast: call the participants of this machine
    rtps::Locator_t peer;
    rtps::IPLocator::setIPv4(peer, "127.0.0.1");
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
    auto* participant =
        fast::DomainParticipantFactory::get_instance()->create_participant(domain, qos);
    if (participant == nullptr) return fail("no participant");

    fast::TypeSupport states_type(new Motors<MotorState>("unitree_go::msg::dds_::MotorStates_"));
    fast::TypeSupport cmds_type(new Motors<MotorCmd>("unitree_go::msg::dds_::MotorCmds_"));
    states_type.register_type(participant);
    cmds_type.register_type(participant);
    auto* states_topic = participant->create_topic("rt/dex1/left/state",
                                                   states_type.get_type_name(),
                                                   fast::TOPIC_QOS_DEFAULT);
    auto* cmds_topic = participant->create_topic("rt/dex1/left/cmd", cmds_type.get_type_name(),
                                                 fast::TOPIC_QOS_DEFAULT);
    auto* subscriber = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
    auto* publisher = participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
    auto* reader = subscriber->create_datareader(states_topic, fast::DATAREADER_QOS_DEFAULT);
    auto* writer = publisher->create_datawriter(cmds_topic, fast::DATAWRITER_QOS_DEFAULT);
    if (reader == nullptr || writer == nullptr) return fail("no reader or no writer");

    int seen = 0;
    float first = NAN, last = NAN;
    bool arrived = false;
    const auto end = std::chrono::steady_clock::now() + kPatience;
    while (!arrived && std::chrono::steady_clock::now() < end) {
        std::vector<MotorState> states;
        fast::SampleInfo info;
        while (reader->take_next_sample(&states, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data || states.empty()) continue;
            last = states[0].q;
            if (seen++ == 0) first = last;  // where it was before any command
        }
        if (seen > 0) {
            MotorCmd command;
            command.mode = 1;
            command.q = kTarget;
            command.kp = 5.0f;
            command.kd = 0.05f;
            std::vector<MotorCmd> commands{command};
            writer->write(&commands);
            arrived = std::fabs(last - kTarget) < kClose;
        }
        std::this_thread::sleep_for(kPeriod);
    }
    std::printf("{\"dds\": \"Fast DDS %d.%d.%d\", \"states\": %d, \"first\": %.3f, "
                "\"last\": %.3f, \"target\": %.1f}\n",
                FASTRTPS_VERSION_MAJOR, FASTRTPS_VERSION_MINOR, FASTRTPS_VERSION_MICRO, seen,
                seen ? first : 0.0, seen ? last : 0.0, kTarget);
    return arrived ? 0 : 1;
}
