// A node of Fast DDS with ROS 2's topic and type names: it sends each Twist of /to_peer back on /from_peer, read and
// written field by field, and answers each Image on /image with a Twist that holds the length of its bytes. With a second
// word it leaves out the last three numbers of what it sends: a malformed Twist.
#include <cstdlib>
#include <functional>
#include <iostream>
#include <memory>
#include <vector>

#include <fastcdr/Cdr.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

struct Twist { double value[6]; };
static int numbers = 6;
using Bytes = std::vector<char>;

template <typename Data> class Support : public TopicDataType {
public:
    Support(const char* name, uint32_t size) { setName(name); m_typeSize = size; m_isGetKeyDefined = false; }
    bool serialize(void* data, SerializedPayload_t* payload) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
        payload->encapsulation = CDR_LE;
        cdr.serialize_encapsulation();
        write(cdr, *static_cast<Data*>(data));
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
        cdr.read_encapsulation();
        return read(cdr, payload, *static_cast<Data*>(data));
    }
    std::function<uint32_t()> getSerializedSizeProvider(void*) override { return [this] { return m_typeSize; }; }
    void* createData() override { return new Data(); }
    void deleteData(void* data) override { delete static_cast<Data*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }

private:
    static void write(eprosima::fastcdr::Cdr& cdr, Twist& twist) {
        for (int i = 0; i < numbers; ++i) cdr << twist.value[i];
    }
    static void write(eprosima::fastcdr::Cdr&, Bytes&) {}
    static bool read(eprosima::fastcdr::Cdr& cdr, SerializedPayload_t*, Twist& twist) {
        for (double& v : twist.value) cdr >> v;
        return true;
    }
    static bool read(eprosima::fastcdr::Cdr&, SerializedPayload_t* payload, Bytes& bytes) {
        bytes.assign(payload->data, payload->data + payload->length);
        return true;
    }
};

template <typename Data> class Answer : public DataReaderListener {
public:
    explicit Answer(DataWriter* writer) : writer_(writer) {}
    void on_data_available(DataReader* reader) override {
        Data data;
        SampleInfo info;
        while (reader->take_next_sample(&data, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            Twist twist = answer(data);
            writer_->write(&twist);
        }
    }

private:
    static Twist answer(const Twist& twist) { return twist; }
    static Twist answer(const Bytes& bytes) { return Twist{{static_cast<double>(bytes.size()), 0, 0, 0, 0, 0}}; }
    DataWriter* writer_;
};

int main(int count, char** words) {
    if (count > 2) numbers = 3;
    auto factory = DomainParticipantFactory::get_instance();
    DomainParticipantQos qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    udp->receiveBufferSize = 4 << 20;  // the default of 208 kB loses parts of an image, which are sent again after 5 ms
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    eprosima::fastrtps::rtps::Locator_t home;
    eprosima::fastrtps::rtps::IPLocator::setIPv4(home, "127.0.0.1");
    qos.wire_protocol().builtin.initialPeersList.push_back(home);
    auto participant = factory->create_participant(count > 1 ? std::atoi(words[1]) : 0, qos);
    TypeSupport twist(new Support<Twist>("geometry_msgs::msg::dds_::Twist_", 4 + 48));
    TypeSupport image(new Support<Bytes>("sensor_msgs::msg::dds_::Image_", 8 << 20));
    twist.register_type(participant);
    image.register_type(participant);
    auto publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    auto subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    DataWriterQos sends;
    sends.reliability().kind = RELIABLE_RELIABILITY_QOS;
    DataReaderQos hears;
    hears.reliability().kind = RELIABLE_RELIABILITY_QOS;
    hears.history().depth = 10;
    auto back = participant->create_topic("rt/from_peer", twist.get_type_name(), TOPIC_QOS_DEFAULT);
    auto there = participant->create_topic("rt/to_peer", twist.get_type_name(), TOPIC_QOS_DEFAULT);
    auto images = participant->create_topic("rt/image", image.get_type_name(), TOPIC_QOS_DEFAULT);
    DataWriter* writer = publisher->create_datawriter(back, sends);
    Answer<Twist> twists(writer);
    Answer<Bytes> pictures(writer);
    subscriber->create_datareader(there, hears, &twists);
    subscriber->create_datareader(images, hears, &pictures);
    std::cout << "ready" << std::endl;
    while (std::cin.get() != EOF) {}
    std::_Exit(0);
}
